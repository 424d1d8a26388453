"""The squared velocity jump at a given approach speed without friction: ``V = H/G²``."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import ImpactKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Lifted, UnknownJump, impact_at, in_world, unknown_jump, weighed
from impact_posture.impact.oracle import ImpactOracle

Vector = NDArray[np.float64]


class SpeedKind(ImpactKind):
    """``V = H/G²``."""

    name, symbol = "speed", "V"
    units = "jump² per (m/s)² of approach, frictionless"
    no_cone = "speed is H/G², no quadratic form of the normal: the exact worst case over a cone is not known for it"

    def value(self, oracle: ImpactOracle, q: Vector) -> float:
        """``V``."""
        return oracle.quantities(q).V

    def gradient(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """``∇H/G² − 2H/G³ ∇G``."""
        found = oracle.quantities(q)
        return oracle.gradient_H(q) / found.G**2 - 2 * found.H / found.G**3 * oracle.gradient_G(q)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """``V`` and its gradient."""
        return k.V, k.grad_V

    def lift(self, case: ImpactCase, tree: Tree, n: ca.SX) -> Lifted:
        """The equations of :func:`frictionless_jump`; the value is ``aᵀWa``."""
        jump, impulse, residual = frictionless_jump(case, tree, n)
        return Lifted(ca.vertcat(jump.variables, impulse), residual, weighed(case.metric, jump, jump))

    def guess(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """See :func:`guess_frictionless`."""
        return guess_frictionless(oracle, q)


def frictionless_jump(case: ImpactCase, tree: Tree, n: ca.SX) -> tuple[UnknownJump, ca.SX, ca.SX]:
    """The jump at unit approach speed without friction, the impulse ``λ`` that causes it, and their equations.

    ``M a − J_sᵀf − λJᵀn = 0``, ``J_s a + εf = 0``, ``nᵀJa = 1``.
    """
    impulse = ca.SX.sym("lam")
    jump = unknown_jump(case, tree, impact_at(case, n * impulse))
    fixing = ca.dot(in_world(case, tree, n), jump.contact_velocity) - 1
    return jump, impulse, ca.vertcat(jump.residual, fixing)


def guess_frictionless(oracle: ImpactOracle, q: Vector) -> Vector:
    """The unknowns of :func:`frictionless_jump` that solve its equations at ``q``."""
    found = oracle.quantities(q)
    return np.concatenate([oracle.with_support_impulses(found.jump / found.G), np.array([1 / found.G])])
