"""One blow along one normal: value, gradients, expressions and lifted form of the four objectives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.contact import point_on
from impact_posture.impact.inner import Subgradients
from impact_posture.impact.lifted import Guess, Lifted, unknown_jump, weighed
from impact_posture.impact.oracle import no_sticking

if TYPE_CHECKING:
    from impact_posture.impact.kernel import ImpactKernel
    from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class OneBlow:
    """No inner maximum but ``λ = λ̄``: the objective at its one normal."""

    objective: ImpactObjective
    attempts: int = 1

    def value(self, q: Vector) -> float:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        found, kind = self.objective.oracle.quantities(q), self.objective.kind
        if kind == "impulse":
            return self.objective.scale * found.H
        if kind == "speed":
            return found.V
        if kind == "energy":
            return found.E
        if found.S is None:
            raise no_sticking()
        return found.S

    def gradient(self, q: Vector) -> Vector:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        oracle, kind = self.objective.oracle, self.objective.kind
        if kind == "impulse":
            return self.objective.scale * oracle.gradient_H(q)
        if kind == "sticking":
            return oracle.gradient_S(q)
        found = oracle.quantities(q)
        if kind == "energy":
            return -oracle.gradient_G(q) / (2 * found.G**2)
        return oracle.gradient_H(q) / found.G**2 - 2 * found.H / found.G**3 * oracle.gradient_G(q)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return Subgradients(self.gradient(q)[None, :], np.zeros(1))

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        if self.objective.kind == "impulse":
            return self.objective.scale * k.H, self.objective.scale * k.grad_H
        if self.objective.kind == "speed":
            return k.V, k.grad_V
        return (k.E, k.grad_E) if self.objective.kind == "energy" else (k.S, k.grad_S)

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return lift_plain(self.objective, tree, n)

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """See :class:`~impact_posture.impact.inner.InnerMaximum`."""
        return guess_plain(self.objective, q)


def lift_plain(objective: ImpactObjective, tree: Tree, n: ca.SX) -> Lifted:
    """The objective with ``a``, the supports' impulses and (for ratios) the contact's impulse as unknowns.

    ``M a − J_sᵀf − Jᵀs = 0`` and ``J_s a + εf = 0``, with ``s = n`` (impulse), ``s = λn, nᵀJa = 1`` (speed,
    energy), or ``s`` free, ``Ja = n`` (sticking).  The value is ``aᵀWa`` or ``λ/2``.
    """
    point = point_on(objective.robot, objective.contact.frame, objective.contact.offset)
    in_frame = objective.contact.normal_frame == "contact"
    zero = ca.SX.zeros(3)
    world_n = tree.rotation(point) @ n if in_frame else n
    if objective.kind == "impulse":
        unknown = ca.SX(0, 1)
        jump = unknown_jump(objective, tree, Wrench(point, n, zero, in_frame=in_frame))
        fixing = ca.SX(0, 1)
    elif objective.kind == "sticking":
        unknown = ca.SX.sym("s", 3)
        jump = unknown_jump(objective, tree, Wrench(point, unknown, zero))
        fixing = jump.contact_velocity - world_n
    else:
        unknown = ca.SX.sym("lam")
        jump = unknown_jump(objective, tree, Wrench(point, n * unknown, zero, in_frame=in_frame))
        fixing = ca.dot(world_n, jump.contact_velocity) - 1
    value = unknown / 2 if objective.kind == "energy" else weighed(objective, jump, jump)
    return Lifted(ca.vertcat(jump.variables, unknown), ca.vertcat(jump.residual, fixing), objective.scale * value)


def guess_plain(objective: ImpactObjective, q: Vector) -> Guess:
    """The auxiliaries of :func:`lift_plain` that solve its equations at ``q``."""
    quantities = objective.oracle.quantities(q)
    if objective.kind == "impulse":
        a, unknown = quantities.jump, np.zeros(0)
    elif objective.kind == "sticking":
        if quantities.sticking_jump is None or quantities.sticking_impulse is None:
            a, unknown = quantities.jump / quantities.G, quantities.normal / quantities.G
        else:
            a, unknown = quantities.sticking_jump, quantities.sticking_impulse
    else:
        a, unknown = quantities.jump / quantities.G, np.array([1 / quantities.G])
    values = np.concatenate([a, -objective.oracle.Js @ a / objective.compliance, unknown])
    return Guess(values, np.full(values.size, -np.inf))
