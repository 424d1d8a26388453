"""The lifted form of an objective, which leaves linear solves to the program as unknowns and equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.contact import point_on
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.metric import Metric

# Start of t above its bounds by attempt, in units of the scale.  A barrier is finite inside only.
ABOVE = (0.01, 1.0, 0.1)


@dataclass(frozen=True)
class Lifted:
    """An objective with its inner linear solve left to the program.

    Attributes:
        variables: Auxiliary unknowns, shape (k, 1).
        residual: Equations that fix them, ``= 0``, shape (r, 1).
        value: The objective in terms of configuration and auxiliaries.
        inequalities: Rows ``≤ 0`` that bound it from below, shape (i, 1).
    """

    variables: ca.SX
    residual: ca.SX
    value: ca.SX
    inequalities: ca.SX = field(default_factory=lambda: ca.SX(0, 1))


@dataclass(frozen=True, eq=False)
class Guess:
    """Initial auxiliaries of a lifted form.

    Attributes:
        values: Values, shape (k,).
        lower: Lower bounds, shape (k,); minus infinity where there is none.
        upper: Upper bounds, shape (k,); ``None`` for none.
    """

    values: Array
    lower: Array
    upper: Array | None = None

    @staticmethod
    def unbounded(values: Array) -> Guess:
        """Return a guess without lower bounds."""
        return Guess(values, np.full(values.size, -np.inf))

    @property
    def above(self) -> Array:
        """Upper bounds, infinite where there are none, shape (k,)."""
        return np.full(self.values.size, np.inf) if self.upper is None else self.upper

    @staticmethod
    def joined(parts: Sequence[Guess]) -> Guess:
        """Return the auxiliaries of several parts as one."""
        keys = ("values", "lower", "above")
        return Guess(*(np.concatenate([np.zeros(0), *[getattr(part, key) for part in parts]]) for key in keys))


@dataclass(frozen=True, eq=False)
class UnknownJump:
    """A jump ``a`` and the support impulses as unknowns.

    Attributes:
        a: Unknown jump, shape (nv,).
        variables: ``a``, the support impulses, and an unknown impulse of the impact if there is one.
        residual: ``M a − J_sᵀf − (the impact)`` and ``J_s a + εf``, and equations that fix the unknown impulse.
        mass_a: ``M a``.
        contact_velocity: ``J a``, world, shape (3,).
    """

    a: ca.SX
    variables: ca.SX
    residual: ca.SX
    mass_a: ca.SX
    contact_velocity: ca.SX

    def with_impulse(self, impulse: ca.SX, fixing: ca.SX) -> UnknownJump:
        """Return the same jump with the impulse of the impact as an unknown, and the equations that fix it."""
        return replace(
            self, variables=ca.vertcat(self.variables, impulse), residual=ca.vertcat(self.residual, fixing)
        )


def unknown_jump(case: ImpactCase, tree: Tree, impact: Wrench, label: str = "") -> UnknownJump:
    """Return unknowns and equations of the velocity jump under one impulse."""
    a = ca.SX.sym(f"a{label}", tree.nv)
    velocities = tree.velocities(a)
    wrenches, held, f = [impact], [], ca.SX(0, 1)
    for k, support in enumerate(case.supports):
        foot = point_on(case.robot, support.frame, support.offset)
        f_k = ca.SX.sym(f"f{label}_{k}", support.rows)
        full = ca.vertcat(f_k, ca.SX.zeros(6 - support.rows))
        wrenches.append(Wrench(foot, full[:3], full[3:]))
        held.append(tree.point_velocity(foot, velocities)[: support.rows] + case.compliance * f_k)
        f = ca.vertcat(f, f_k)
    mass_a = tree.mass_times(a)
    momentum = mass_a - tree.generalized_force(wrenches)
    for k in tree.locked:
        momentum[k] = a[k]
    return UnknownJump(
        a=a,
        variables=ca.vertcat(a, f),
        residual=ca.vertcat(momentum, *held),
        mass_a=mass_a,
        contact_velocity=tree.point_velocity(impact.point, velocities)[:3],
    )


def impact_at(case: ImpactCase, impulse: ca.SX) -> Wrench:
    """Return an impulse at the contact point, in the axes of the contact's normal."""
    return Wrench(case.point, impulse, ca.SX.zeros(3), in_frame=case.in_contact_frame)


def in_world(case: ImpactCase, tree: Tree, directions: ca.SX) -> ca.SX:
    """Turn directions (columns) from the axes of the contact's normal to world axes."""
    return tree.rotation(case.point) @ directions if case.in_contact_frame else directions


def weighed(metric: Metric, one: UnknownJump, other: UnknownJump) -> ca.SX:
    """Return ``a₁ᵀWa₂``."""
    if metric.kind == "kinetic":
        # sᵀJa − ε|f|² is equal on the equations, but a small difference of large numbers if the feet are stiff.
        return ca.dot(one.a, other.mass_a)
    return ca.dot(one.a, ca.SX(metric.diagonal(one.a.numel())) * other.a)


def worst_of(parts: Sequence[Lifted], values: Sequence[ca.SX], scale: ca.SX) -> Lifted:
    """Return ``t`` with ``values[k] ≤ t · scale``, over the unknowns and equations of all parts."""
    t = ca.SX.sym("t")
    return Lifted(
        variables=ca.vertcat(*[p.variables for p in parts], t),
        residual=ca.vertcat(*[p.residual for p in parts]),
        value=t * scale,
        inequalities=ca.vertcat(*[p.inequalities for p in parts], *[v / scale - t for v in values]),
    )


def worst_of_guesses(parts: Sequence[Guess], largest: float, attempt: int) -> Guess:
    """Return the start of :func:`worst_of`, with ``t`` above the largest value (in units of the scale)."""
    return Guess.joined([*parts, Guess.unbounded(np.array([largest + ABOVE[attempt]]))])
