"""Abstract base classes of the objective types; each type defines one scalar of an impact that is minimized."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import (
    Guess,
    Lifted,
    UnknownJump,
    impact_at,
    in_world,
    unknown_jump,
    weighed,
)
from impact_posture.impact.quantities.sticking_point import no_sticking
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class ImpactKind(ABC):
    """Objective type: a multiple of H, V, S, C, E or m for a single impact along a given normal.

    The class implements :class:`~impact_posture.impact.objective.WorstCase`.  An objective type computes no maximum,
    because the largest impulse ``λ̄`` is the worst case, or the approach speed determines the impulse.
    :attr:`symbol` names the attributes of :class:`ImpactOracle` and :class:`ImpactKernel` that provide value and
    gradient.  Subclasses define the equations of the lifted form (:class:`Lifted`).

    Attributes:
        name: Name in options, files and outputs.
        symbol: Symbol of the scalar: H, V, S, C, E or m.
        units: Units of the value, as text.
        adds_up: Whether the impulse of each contact is given, so that the velocity jumps of several contacts add up.
        simultaneous: Whether several contacts can arrive at the same time and at the same speed.
        kink: Text that states where the gradient is discontinuous, and which gradient is returned there; empty if
            the value is smooth.
        no_cone: Reason why the worst case over a cone of normals cannot be computed exactly.
        attempts: Number of different initial guesses that :meth:`guess` offers.
    """

    oracle: ImpactOracle
    name: ClassVar[str]
    symbol: ClassVar[str]
    units: ClassVar[str]
    adds_up: ClassVar[bool] = False
    simultaneous: ClassVar[bool] = False
    kink: ClassVar[str] = ""
    no_cone: ClassVar[str] = "it is not a quadratic form of the normal"
    attempts: ClassVar[int] = 1

    @property
    def case(self) -> ImpactCase:
        """Robot, contact, metric and supports of the impact."""
        return self.oracle.case

    @property
    def factor(self) -> float:
        """Factor between the scalar :attr:`symbol` and the value."""
        return 1.0

    def value(self, q: Array) -> float:
        value = getattr(self.oracle.quantities(q), self.symbol)
        if value is None:
            raise no_sticking()
        return self.factor * float(value)

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the tangent gradient, which is the only subgradient because the value is smooth."""
        gradient = self.factor * getattr(self.oracle, f"gradient_{self.symbol}")(q)
        return Subgradients(gradient[None, :], np.zeros(1))

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        return self.factor * getattr(k, self.symbol), self.factor * getattr(k, f"grad_{self.symbol}")

    @abstractmethod
    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return unknowns and equations for the velocity jump at ``tree.q`` that an impact along ``n`` causes."""

    @abstractmethod
    def jump(self, q: Array) -> tuple[Array, Array]:
        """Solve the equations of :meth:`unknowns` at ``q``; return the velocity jump (nv) and the other unknowns."""

    def lifted_value(self, jump: UnknownJump) -> ca.SX:
        """Return the value for the unknown velocity jump ``a``: ``aᵀWa`` times :attr:`factor`."""
        return self.factor * weighed(self.case.metric, jump, jump)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the lifted form at ``tree.q``; ``parameters`` is the contact normal."""
        jump = self.unknowns(tree, parameters)
        return Lifted.of([jump], self.lifted_value(jump))

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        a, others = self.jump(q)
        return Guess.unbounded(np.concatenate([self.oracle.with_support_impulses(a), others]))


class FrictionlessKind(ImpactKind):
    """Objective type for an approach speed of 1 m/s without friction; the impulse ``λ`` is unknown."""

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return the velocity jump with ``M a − J_sᵀf − λJᵀn = 0``, ``J_s a + εf = 0``, ``nᵀJa = 1``.

        The last unknown is ``λ``.
        """
        impulse = ca.SX.sym(f"lam{label}")
        jump = unknown_jump(self.case, tree, [impact_at(self.case, n * impulse)], label)
        return jump.with_impulse(impulse, ca.dot(in_world(self.case, tree, n), jump.contact_velocity) - 1)

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return the frictionless velocity jump and the impulse ``λ = 1/G``."""
        quantities = self.oracle.quantities(q)
        return quantities.jump / quantities.G, np.array([1 / quantities.G])


class QuadraticKind(ImpactKind):
    """Objective type whose value increases with a quadratic form ``nᵀK(q)n`` of the normal ``n``.

    The largest value of a quadratic form over a cone of normals can be computed exactly.  By default ``K = Λ_c``.

    Attributes:
        unknown_impulse: Whether the unknowns of :meth:`lift_direction` include the impulse.
    """

    unknown_impulse: ClassVar[bool] = False

    def directions(self, mobility: Array, world: Array) -> Array:
        """Return three impulses as columns, shape (3, 3); :meth:`form` needs the velocity jumps that they cause.

        Impulse k belongs to the world direction in column k of ``world``, shape (3, 3).  ``mobility`` is ``JM⁻¹Jᵀ``,
        shape (3, 3).

        Raises:
            MetricError: The inverse of ``mobility`` is needed, but ``mobility`` is singular.
        """
        return world

    def form(self, mobility: Array, world: Array, jumps: Array) -> Array:
        """Return ``K`` in the axes ``world`` (columns), shape (3, 3).

        ``jumps`` are the velocity jumps (columns) that the impulses of :meth:`directions` cause.
        """
        return np.asarray(jumps.T @ self.oracle.weigh(jumps))

    @abstractmethod
    def form_gradient(self, q: Array, n: Array) -> Array:
        """Return the tangent gradient of ``nᵀK(q)n``, shape (nv,), for a fixed ``n`` of any length."""

    @abstractmethod
    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """Return ``K`` in world axes, shape (3, 3)."""

    def of_form(self, form: Array) -> Array:
        """Return the objective for each value ``form = nᵀKn``."""
        return self.factor * form

    def of_form_slope(self, form: Array) -> Array:
        """Return the derivative of the objective with respect to ``form = nᵀKn``."""
        return np.full_like(form, self.factor)

    def of_form_expression(self, form: ca.SX) -> ca.SX:
        """Return the objective as an expression of ``form = nᵀKn``."""
        return self.factor * form

    def lift_direction(self, tree: Tree, n: ca.SX, label: str) -> UnknownJump:
        """Return unknowns and equations for the jump of an impact along ``n``, given in the axes ``normal_frame``."""
        return self.unknowns(tree, n, label)

    def lift_entry(self, world: ca.SX, first: UnknownJump, second: UnknownJump) -> ca.SX:
        """Return the entry of ``K`` for two velocity jumps; ``world`` is the world direction of the first impact."""
        return weighed(self.case.metric, first, second)

    def form_unit(self, value: Any) -> Any:
        """Return ``|nᵀKn|`` for which the objective equals ``value``, a number or an expression."""
        return value / self.factor
