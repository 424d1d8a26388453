"""The lifted form of an objective, in which the nonlinear program solves the linear systems of the impact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from impact_posture.dynamics.jump_derivatives import Foot, JumpDerivatives
from impact_posture.dynamics.tree import Coupled, Tree, Wrench
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.metric import Metric
from impact_posture.system.arrays import Array

# Initial distance of the unknown ``t`` of :func:`worst_of` from the lower bounds of ``t``, divided by ``scale``, for
# each attempt.  The interior-point method needs a start that satisfies the inequalities strictly.
ABOVE = (0.01, 1.0, 0.1)


@dataclass(frozen=True)
class Lifted:
    """An objective whose linear systems are equations of the nonlinear program.

    Attributes:
        variables: Unknowns that the objective adds to the program, shape (k, 1).
        residual: Left sides of the equations ``residual = 0`` that determine the unknowns, shape (r, 1).
        value: The objective as an expression of the configuration and the unknowns.
        inequalities: Expressions that must be ``≤ 0``, shape (i, 1).  These inequalities bound the value from below.
        jumps: Unknown velocity jumps whose derivatives are available in closed form.
    """

    variables: ca.SX
    residual: ca.SX
    value: ca.SX
    inequalities: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    jumps: tuple[PlacedJump, ...] = ()

    @staticmethod
    def of(
        parts: Sequence[Lifted | UnknownJump],
        value: ca.SX,
        *,
        others: Sequence[ca.SX] = (),
        equations: Sequence[ca.SX] = (),
        inequalities: Sequence[ca.SX] = (),
    ) -> Lifted:
        """Return a lifted form with the unknowns, equations and inequalities of all ``parts``.

        The additional unknowns ``others``, the ``equations`` and the ``inequalities`` come last.
        """
        row, column, placed = 0, 0, list[PlacedJump]()
        for part in parts:
            placed += [PlacedJump(jump, row + below, column + right) for jump, below, right in part.jumps]
            row, column = row + part.residual.numel(), column + part.variables.numel()
        bounds = [part.inequalities for part in parts if isinstance(part, Lifted)]
        return Lifted(
            ca.vertcat(*[part.variables for part in parts], *others),
            ca.vertcat(*[part.residual for part in parts], *equations),
            value,
            ca.vertcat(ca.SX(0, 1), *bounds, *inequalities),
            tuple(placed),
        )

    @property
    def rest(self) -> ca.SX:
        """The residual without the terms that have derivatives in closed form, shape (r, 1)."""
        rest = ca.SX(self.residual)
        for jump, row, _ in self.jumps:
            rest[row : row + jump.rest.numel()] = jump.rest
        return rest


@dataclass(frozen=True, eq=False)
class Guess:
    """Initial values and bounds of the unknowns of a lifted form.

    Attributes:
        values: Initial values, shape (k,).
        lower: Lower bounds, shape (k,); minus infinity for an unbounded unknown.
        upper: Upper bounds, shape (k,); ``None`` if no unknown has an upper bound.
    """

    values: Array
    lower: Array
    upper: Array | None = None

    @staticmethod
    def unbounded(values: Array) -> Guess:
        """Return a guess without bounds."""
        return Guess(values, np.full(values.size, -np.inf))

    @property
    def above(self) -> Array:
        """Upper bounds, shape (k,); infinite for an unknown without an upper bound."""
        return np.full(self.values.size, np.inf) if self.upper is None else self.upper

    @staticmethod
    def joined(parts: Sequence[Guess]) -> Guess:
        """Concatenate guesses."""
        keys = ("values", "lower", "above")
        return Guess(*(np.concatenate([np.zeros(0), *[getattr(part, key) for part in parts]]) for key in keys))


@dataclass(frozen=True, eq=False)
class UnknownJump:
    """A velocity jump ``a`` and its support impulses, as unknowns of the program.

    Attributes:
        a: Unknown jump, shape (nv,).
        f: Unknown support impulses, in the axes of the feet.
        variables: All unknowns: ``a``, ``f``, and the impulse of the impact if it is unknown.
        residual: ``M a − J_sᵀf − (generalized impulse of the impact)``, then ``J_s a + εf``, then equations that
            determine the impulse of the impact if this impulse is unknown.
        rest: The terms of the residual without derivatives in closed form: the impulse of the impact, and the rows
            of locked joints.
        derivatives: Derivatives of ``residual − rest`` in closed form.
        compliance: Compliance ε of the supports, 1/kg.
        tree: The kinematic tree.  Each locked joint k has the equation ``a_k = 0``.
        contact_velocity: Velocity jump ``J a`` of the m points with impulses, world axes, shape (3m,).
        couplings: Coupled joints.  A follower f has the equation ``a_f = ratio · a_l``, and its momentum is added to
            the equation of its leader l.
    """

    a: ca.SX
    f: ca.SX
    variables: ca.SX
    residual: ca.SX
    rest: ca.SX
    derivatives: JumpDerivatives
    compliance: float
    tree: Tree
    contact_velocity: ca.SX
    couplings: Sequence[Coupled] = ()

    @property
    def jumps(self) -> tuple[PlacedJump, ...]:
        """The jump as the first part of a :class:`Lifted`; empty if no derivatives exist in closed form."""
        return (PlacedJump(self, 0, 0),) if self.derivatives.exist else ()

    def with_impulse(self, impulse: ca.SX, fixing: ca.SX) -> UnknownJump:
        """Return a copy with the additional unknowns ``impulse``, which the equations ``fixing = 0`` determine."""
        residual, rest = (ca.vertcat(rows, fixing) for rows in (self.residual, self.rest))
        return replace(self, variables=ca.vertcat(self.variables, impulse), residual=residual, rest=rest)

    def known_derivatives(self, multipliers: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return Jacobian and Hessian of ``residual − rest`` for the unknowns (chart coordinates, ``a``, ``f``)."""
        count, locked = self.a.numel(), list(self.tree.locked)
        moving = ca.SX.ones(count)
        moving[locked] = 0
        b, of_feet = moving * multipliers[:count], multipliers[count : count + self.f.numel()]
        for follower, leader, ratio in self.couplings:
            b[follower] = ratio * b[leader]
        jacobian, hessian = self.derivatives.of(self.a, self.f, b, of_feet, self.compliance)
        for follower, leader, ratio in self.couplings:
            jacobian[leader, :] += ratio * jacobian[follower, :]
            locked.append(follower)
        jacobian[locked, :] = 0
        return ca.sparsify(jacobian), hessian


class PlacedJump(NamedTuple):
    """An unknown velocity jump; its derivatives begin at ``row`` and ``column`` of the Jacobian of a lifted form."""

    jump: UnknownJump
    row: int
    column: int


def unknown_jump(case: ImpactCase, tree: Tree, impacts: Sequence[Wrench], label: str = "") -> UnknownJump:
    """Return unknowns and equations for the velocity jump that the impulses ``impacts`` cause at ``tree.q``."""
    a = ca.SX.sym(f"a{label}", tree.nv)
    velocities = tree.velocities(a)
    feet = [Foot(point_on(case.robot, s.frame, s.offset), s.rows) for s in case.supports]
    wrenches, held, f = list[Wrench](), list[ca.SX](), ca.SX(0, 1)
    for k, foot in enumerate(feet):
        f_k = ca.SX.sym(f"f{label}_{k}", foot.rows)
        full = ca.vertcat(f_k, ca.SX.zeros(6 - foot.rows))
        wrenches.append(Wrench(foot.point, full[:3], full[3:], in_frame=True))
        held.append(tree.own_velocity(foot.point, velocities)[: foot.rows] + case.compliance * f_k)
        f = ca.vertcat(f, f_k)
    pushed = -tree.generalized_force(impacts)
    momentum = tree.mass_times(a, velocities, wrenches=wrenches) + pushed
    for follower, leader, ratio in case.robot.coupled_entries:
        for rows in (momentum, pushed):
            rows[leader] += ratio * rows[follower]
            rows[follower] = a[follower] - ratio * a[leader]
    for k in tree.locked:
        momentum[k] = pushed[k] = a[k]
    return UnknownJump(
        a=a,
        f=f,
        variables=ca.vertcat(a, f),
        residual=ca.vertcat(momentum, *held),
        rest=ca.vertcat(pushed, ca.SX(f.numel(), 1)),
        derivatives=JumpDerivatives(tree, feet),
        compliance=case.compliance,
        tree=tree,
        contact_velocity=tree.point_velocities([impact.point for impact in impacts], velocities),
        couplings=case.robot.coupled_entries,
    )


def impact_at(case: ImpactCase, impulse: ca.SX) -> Wrench:
    """Return ``impulse``, in the axes ``normal_frame`` of the contact, as a wrench at the contact point."""
    return Wrench(case.point, impulse, ca.SX.zeros(3), in_frame=case.in_contact_frame)


def in_world(case: ImpactCase, tree: Tree, directions: ca.SX) -> ca.SX:
    """Turn directions (columns) from the axes ``normal_frame`` of the contact to world axes."""
    return tree.rotation(case.point) @ directions if case.in_contact_frame else directions


def weighed(metric: Metric, first: UnknownJump, second: UnknownJump) -> ca.SX:
    """Return ``a₁ᵀWa₂`` for two unknown velocity jumps."""
    if metric.kind == "kinetic":
        # The equations imply a₁ᵀMa₂ = sᵀJa₂ − εf₁ᵀf₂, but with stiff feet this difference loses digits.
        return ca.dot(first.a, second.tree.mass_times(second.a))
    weights = metric.diagonal(first.a.numel())
    weights[[follower for follower, _, _ in first.couplings]] = 0.0
    return ca.dot(first.a, ca.SX(weights) * second.a)


def worst_of(parts: Sequence[Lifted | UnknownJump], values: Sequence[ca.SX], scale: ca.SX) -> Lifted:
    """Return the lifted form of the maximum of ``values``: ``t · scale`` with ``values[k] ≤ t · scale`` for all k.

    The unknowns are ``t`` and the unknowns of all ``parts``.
    """
    t = ca.SX.sym("t")
    return Lifted.of(parts, t * scale, others=[t], inequalities=[v / scale - t for v in values])


def worst_of_guesses(parts: Sequence[Guess], largest: float, attempt: int) -> Guess:
    """Return initial values for :func:`worst_of`; ``largest`` is the maximum of ``values``, divided by ``scale``."""
    return Guess.joined([*parts, Guess.unbounded(np.array([largest + ABOVE[attempt]]))])
