"""The paper's objective: the squared velocity jump under the largest impulse, ``λ̄²H``."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import QuadraticKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Lifted, impact_at, unknown_jump, weighed
from impact_posture.impact.oracle import ImpactOracle

Vector = NDArray[np.float64]


class ImpulseKind(QuadraticKind):
    """``λ̄²H``, ``H = nᵀΛ_c n``; as a form of the normal ``K = Λ_c``."""

    name, symbol = "impulse", "H"
    units = "(N·s)² × jump² per impulse²"
    adds_up = True

    def factor(self, case: ImpactCase) -> float:
        """``λ̄²``."""
        return case.contact.impulse**2

    def value(self, oracle: ImpactOracle, q: Vector) -> float:
        """``λ̄²H``."""
        return self.factor(oracle.case) * oracle.quantities(q).H

    def gradient(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """``λ̄²∇H``."""
        return self.factor(oracle.case) * oracle.gradient_H(q)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """``λ̄²H`` and its gradient."""
        factor = self.factor(k.case)
        return factor * k.H, factor * k.grad_H

    def lift(self, case: ImpactCase, tree: Tree, n: ca.SX) -> Lifted:
        """``M a − J_sᵀf − Jᵀn = 0``, ``J_s a + εf = 0``; the value is ``λ̄²aᵀWa``."""
        jump = unknown_jump(case, tree, impact_at(case, n))
        return Lifted(jump.variables, jump.residual, self.factor(case) * weighed(case.metric, jump, jump))

    def guess(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """``a = M⁻¹Jᵀn`` and the supports' impulses."""
        return oracle.with_support_impulses(oracle.quantities(q).jump)

    def form_gradient(self, oracle: ImpactOracle, q: Vector, n: Vector) -> Vector:
        """``∇H`` along ``n``."""
        return oracle.gradient_H(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """``Λ_c``."""
        return k.ellipsoid
