"""The abstract bases of the kinds of objective, each of which minimizes one scalar of an impact."""

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
    """A multiple of H, G, V, S or E of one impact along one normal.

    It implements :class:`~impact_posture.impact.objective.WorstCase` without a maximum, because ``λ = λ̄``.  Value,
    gradient and expressions follow from the attributes of the oracle and the kernel with the name :attr:`symbol`.  A
    kind adds the equations of its lifted form.

    Attributes:
        name: Name in options, files and outputs.
        symbol: Name of the scalar: H, G, V, S or E.
        units: Units in words.
        adds_up: Whether the impulses of several contacts at once are known, so that their jumps add up.
        kink: Where the value has a kink, and which gradient it has there; empty for a smooth value.
        no_cone: Reason why no exact worst case over a cone of normals exists.
    """

    oracle: ImpactOracle
    name: ClassVar[str]
    symbol: ClassVar[str]
    units: ClassVar[str]
    adds_up: ClassVar[bool] = False
    kink: ClassVar[str] = ""
    no_cone: ClassVar[str] = "it is not a quadratic form of the normal"
    attempts: ClassVar[int] = 1

    @property
    def case(self) -> ImpactCase:
        """The impact."""
        return self.oracle.case

    @property
    def factor(self) -> float:
        """Ratio of the value to the scalar :attr:`symbol`."""
        return 1.0

    def value(self, q: Array) -> float:
        """Return the value, computed with Pinocchio.

        Raises:
            MetricError: The value does not exist at ``q``.
        """
        value = getattr(self.oracle.quantities(q), self.symbol)
        if value is None:
            raise no_sticking()
        return self.factor * float(value)

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the tangent gradient, computed with Pinocchio, as the only member, because the value is smooth."""
        gradient = self.factor * getattr(self.oracle, f"gradient_{self.symbol}")(q)
        return Subgradients(gradient[None, :], np.zeros(1))

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and tangent gradient (nv) in the symbols of a kernel."""
        return self.factor * getattr(k, self.symbol), self.factor * getattr(k, f"grad_{self.symbol}")

    @abstractmethod
    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return the unknown jump at ``tree.q`` along the normal ``n``, with the equations that determine it."""

    @abstractmethod
    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return the jump (nv,) and the other unknowns that solve the equations of :meth:`unknowns` at ``q``."""

    def lifted_value(self, jump: UnknownJump) -> ca.SX:
        """Return the value in terms of the unknown jump: ``aᵀWa`` times the factor."""
        return self.factor * weighed(self.case.metric, jump, jump)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the lifted form at ``tree.q`` and the normal ``parameters``."""
        jump = self.unknowns(tree, parameters)
        return Lifted.of([jump], self.lifted_value(jump))

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return the unknowns of :meth:`lift` that solve its equations at ``q``."""
        a, others = self.jump(q)
        return Guess.unbounded(np.concatenate([self.oracle.with_support_impulses(a), others]))


class FrictionlessKind(ImpactKind):
    """A kind at unit approach speed without friction, with an unknown impulse ``λ``."""

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return ``M a − J_sᵀf − λJᵀn = 0``, ``J_s a + εf = 0``, ``nᵀJa = 1``; ``λ`` is the last unknown."""
        impulse = ca.SX.sym(f"lam{label}")
        jump = unknown_jump(self.case, tree, impact_at(self.case, n * impulse), label)
        return jump.with_impulse(impulse, ca.dot(in_world(self.case, tree, n), jump.contact_velocity) - 1)

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return ``a/G`` and ``λ = 1/G``."""
        quantities = self.oracle.quantities(q)
        return quantities.jump / quantities.G, np.array([1 / quantities.G])


class QuadraticKind(ImpactKind):
    """A kind whose value rises with one quadratic form ``nᵀK(q)n`` of the normal.

    A quadratic form has an exact worst case over a cone of normals.  By default ``K = Λ_c``.

    Attributes:
        unknown_impulse: Whether the unknowns of :meth:`lift_direction` include the impulse.
    """

    unknown_impulse: ClassVar[bool] = False

    def directions(self, mobility: Array, world: Array) -> Array:
        """Return the impulses from whose jumps :meth:`form` follows along world directions (columns), shape (3, 3).

        Raises:
            MetricError: They do not exist with this ``JM⁻¹Jᵀ``, shape (3, 3).
        """
        return world

    def form(self, mobility: Array, world: Array, jumps: Array) -> Array:
        """Return ``K`` along world directions (columns) whose impulses cause ``jumps`` (columns), shape (3, 3)."""
        return np.asarray(jumps.T @ self.oracle.weigh(jumps))

    @abstractmethod
    def form_gradient(self, q: Array, n: Array) -> Array:
        """Return the tangent gradient of ``nᵀK(q)n``, shape (nv,), for a fixed ``n`` of any length."""

    @abstractmethod
    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """Return ``K`` in world axes, shape (3, 3)."""

    def of_form(self, form: Array) -> Array:
        """Return the objective for values of the form."""
        return self.factor * form

    def of_form_slope(self, form: Array) -> Array:
        """Return the derivative of :meth:`of_form`."""
        return np.full_like(form, self.factor)

    def of_form_expression(self, form: ca.SX) -> ca.SX:
        """Return :meth:`of_form` as an expression."""
        return self.factor * form

    def lift_direction(self, tree: Tree, n: ca.SX, label: str) -> UnknownJump:
        """Return the unknown jump of a direction ``n`` of the form, in the axes of the normal, shape (3,)."""
        return self.unknowns(tree, n, label)

    def lift_entry(self, world: ca.SX, first: UnknownJump, second: UnknownJump) -> ca.SX:
        """Return an entry of ``K`` from the jumps of two directions; ``world`` is the first direction."""
        return weighed(self.case.metric, first, second)

    def form_unit(self, value: Any) -> Any:
        """Return the absolute value of the form where the objective has ``value``, a number or an expression."""
        return value / self.factor
