"""The objective type ``impulse``: squared velocity jump under the largest impulse."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.kinds.impact_kind import QuadraticKind
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.lifted_form import UnknownJump, impact_at, unknown_jump
from impact_posture.system.arrays import Array


class ImpulseKind(QuadraticKind):
    """``λ̄²H`` with ``H = nᵀKn`` and ``K = Λ_c``: squared velocity jump under the largest impulse ``λ̄``."""

    name, symbol = "impulse", "H"
    units = "(N·s)² × jump² per impulse²"
    adds_up = True

    @property
    def factor(self) -> float:
        return self.case.contact.impulse**2

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return the velocity jump ``a`` with the equations ``M a − J_sᵀf − Jᵀn = 0``, ``J_s a + εf = 0``."""
        return unknown_jump(self.case, tree, [impact_at(self.case, n)], label)

    def jump(self, q: Array) -> tuple[Array, Array]:
        return self.oracle.quantities(q).jump, np.zeros(0)

    def form_gradient(self, q: Array, n: Array) -> Array:
        return self.oracle.gradient_H(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        return k.ellipsoid
