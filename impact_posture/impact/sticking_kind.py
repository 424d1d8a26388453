"""The squared velocity jump at a given approach speed when the contact point sticks: ``S``."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import QuadraticKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Lifted, UnknownJump, in_world, unknown_jump, weighed
from impact_posture.impact.oracle import ImpactOracle, no_sticking

Vector = NDArray[np.float64]

# Below this share of the largest, an eigenvalue of JM⁻¹Jᵀ is zero.
_SINGULAR = 1e-9


class StickingKind(QuadraticKind):
    """``S = ‖M⁻¹Jᵀ(JM⁻¹Jᵀ)⁻¹n‖²_W``; as a form of the normal ``K = B⁻¹Λ_cB⁻¹`` with ``B = JM⁻¹Jᵀ``."""

    name, symbol = "sticking", "S"
    units = "jump² per (m/s)² of approach, no slip"

    def value(self, oracle: ImpactOracle, q: Vector) -> float:
        """``S``.

        Raises:
            MetricError: It does not exist at ``q``.
        """
        found = oracle.quantities(q).S
        if found is None:
            raise no_sticking()
        return found

    def gradient(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """``∇S``."""
        return oracle.gradient_S(q)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """``S`` and its gradient."""
        return k.S, k.grad_S

    def lift(self, case: ImpactCase, tree: Tree, n: ca.SX) -> Lifted:
        """``M a − J_sᵀf − Jᵀs = 0``, ``J_s a + εf = 0``, ``J a = n`` with ``s`` unknown; the value is ``aᵀWa``."""
        impulse = ca.SX.sym("s", 3)
        jump = unknown_jump(case, tree, Wrench(case.point, impulse, ca.SX.zeros(3)))
        fixing = jump.contact_velocity - in_world(case, tree, n)
        return Lifted(
            ca.vertcat(jump.variables, impulse),
            ca.vertcat(jump.residual, fixing),
            weighed(case.metric, jump, jump),
        )

    def guess(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """``a``, the supports' impulses and ``s``; those without friction where ``S`` does not exist."""
        found = oracle.quantities(q)
        if found.sticking_jump is None or found.sticking_impulse is None:
            a, impulse = found.jump / found.G, found.normal / found.G
        else:
            a, impulse = found.sticking_jump, found.sticking_impulse
        return np.concatenate([oracle.with_support_impulses(a), impulse])

    def directions(self, mobility: Vector, world: Vector) -> Vector:
        """``B⁻¹`` times the directions."""
        sizes = np.linalg.eigvalsh((mobility + mobility.T) / 2)
        if sizes[0] <= _SINGULAR * sizes[-1]:
            raise no_sticking()
        return np.asarray(np.linalg.solve(mobility, world))

    def form_gradient(self, oracle: ImpactOracle, q: Vector, n: Vector) -> Vector:
        """``∇S`` along ``n``."""
        return oracle.gradient_S(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """``B⁻¹Λ_cB⁻¹``."""
        return k.sticking_form

    def lift_direction(
        self, case: ImpactCase, tree: Tree, impact: Wrench, world: ca.SX, label: str
    ) -> tuple[UnknownJump, ca.SX, ca.SX]:
        """A jump whose impulse ``s`` is unknown, with ``J a`` along the direction."""
        impulse = ca.SX.sym(f"s{label}", 3)
        jump = unknown_jump(case, tree, Wrench(case.point, impulse, ca.SX.zeros(3)), label)
        return (
            jump,
            ca.vertcat(jump.variables, impulse),
            ca.vertcat(jump.residual, jump.contact_velocity - world),
        )

    def guess_direction(self, jump: Vector, support_impulse: Vector, impulse: Vector) -> list[Vector]:
        """The jump, the supports' impulses and ``s``."""
        return [jump, support_impulse, impulse]
