"""The objective type ``sticking``: squared velocity jump per squared approach speed if the contact point sticks."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.kinds.impact_kind import QuadraticKind
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.lifted_form import UnknownJump, in_world, unknown_jump
from impact_posture.impact.quantities.sticking_point import SINGULAR, no_sticking
from impact_posture.system.arrays import Array


class StickingKind(QuadraticKind):
    """``S = nᵀKn`` with ``K = B⁻¹Λ_cB⁻¹`` and ``B = JM⁻¹Jᵀ``.

    ``S`` is the squared velocity jump per squared approach speed if the contact point sticks.
    """

    name, symbol = "sticking", "S"
    units = "jump² per (m/s)² of approach, no slip"
    unknown_impulse = True
    simultaneous = True

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return the velocity jump ``a`` with ``M a − J_sᵀf − Jᵀs = 0``, ``J_s a + εf = 0``, ``J a = n``.

        The last three unknowns are the impulse ``s`` on the contact point.
        """
        impulse = ca.SX.sym(f"s{label}", 3)
        jump = unknown_jump(self.case, tree, [Wrench(self.case.point, impulse, ca.SX.zeros(3))], label)
        return jump.with_impulse(impulse, jump.contact_velocity - in_world(self.case, tree, n))

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return the velocity jump and the impulse ``s``, or their frictionless values if ``S`` does not exist."""
        quantities = self.oracle.quantities(q)
        if quantities.sticking_jump is None or quantities.sticking_impulse is None:
            return quantities.jump / quantities.G, quantities.normal / quantities.G
        return quantities.sticking_jump, quantities.sticking_impulse

    def directions(self, mobility: Array, world: Array) -> Array:
        sizes = np.linalg.eigvalsh((mobility + mobility.T) / 2)
        if sizes[0] <= SINGULAR * sizes[-1]:
            raise no_sticking()
        return np.asarray(np.linalg.solve(mobility, world))

    def form_gradient(self, q: Array, n: Array) -> Array:
        return self.oracle.gradient_S(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        return k.sticking_form
