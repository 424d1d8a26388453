"""What of an impact is minimized: the abstract base of the kinds of objective."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Lifted, UnknownJump, unknown_jump, weighed
from impact_posture.impact.oracle import ImpactOracle

Vector = NDArray[np.float64]


class ImpactKind(ABC):
    """A scalar of one impact along one normal, with its gradient, its expressions and its lifted form.

    Attributes:
        name: Its name in options, files and outputs.
        symbol: Which of H, G, V, S, E it is a multiple of.
        units: Units in words.
        adds_up: Whether the impulses of several contacts at once are known, so that their jumps add up.
        no_cone: Why it has no exact worst case over a cone of normals.
    """

    name: ClassVar[str]
    symbol: ClassVar[str]
    units: ClassVar[str]
    adds_up: ClassVar[bool] = False
    no_cone: ClassVar[str] = "it is no quadratic form of the normal"

    def factor(self, case: ImpactCase) -> float:
        """The value over the scalar that :attr:`symbol` names."""
        return 1.0

    @abstractmethod
    def value(self, oracle: ImpactOracle, q: Vector) -> float:
        """The value from Pinocchio's numbers.

        Raises:
            MetricError: It does not exist at ``q``.
        """

    @abstractmethod
    def gradient(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """Tangent gradient from Pinocchio's numbers, shape (nv,)."""

    @abstractmethod
    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Value and tangent gradient (nv) in the symbols of a kernel."""

    @abstractmethod
    def lift(self, case: ImpactCase, tree: Tree, n: ca.SX) -> Lifted:
        """The value with the linear solve left to the program, at ``tree.q`` and the normal ``n``."""

    @abstractmethod
    def guess(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """The unknowns of :meth:`lift` that solve its equations at ``q``."""


class QuadraticKind(ImpactKind):
    """A kind whose value rises with one quadratic form ``nᵀK(q)n`` of the normal.

    Such a kind has an exact worst case over a cone of normals.  The defaults are those of ``K = Λ_c``.
    """

    def directions(self, mobility: Vector, world: Vector) -> Vector:
        """Impulses whose jumps make up the form along world directions (columns), world axes, shape (3, 3).

        Raises:
            MetricError: They do not exist with this ``JM⁻¹Jᵀ``, shape (3, 3).
        """
        return world

    def form(self, oracle: ImpactOracle, mobility: Vector, world: Vector, jumps: Vector) -> Vector:
        """``K`` along world directions (columns) whose impulses cause ``jumps`` (columns), shape (3, 3)."""
        return np.asarray(jumps.T @ oracle.weigh(jumps))

    @abstractmethod
    def form_gradient(self, oracle: ImpactOracle, q: Vector, n: Vector) -> Vector:
        """Tangent gradient of ``nᵀK(q)n`` with ``n`` held fixed, of any length, shape (nv,)."""

    @abstractmethod
    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """``K`` in world axes, shape (3, 3)."""

    def of_form(self, case: ImpactCase, form: Vector) -> Vector:
        """The values where the form has these."""
        return self.factor(case) * form

    def of_form_slope(self, case: ImpactCase, form: Vector) -> Vector:
        """Derivative of :meth:`of_form`."""
        return np.full_like(form, self.factor(case))

    def of_form_expression(self, case: ImpactCase, form: ca.SX) -> ca.SX:
        """:meth:`of_form` as an expression."""
        return self.factor(case) * form

    def lift_direction(
        self, case: ImpactCase, tree: Tree, impact: Wrench, world: ca.SX, label: str
    ) -> tuple[UnknownJump, ca.SX, ca.SX]:
        """Jump, unknowns and equations of one direction of the form.

        Args:
            case: The impact.
            tree: The tree at the program's configuration.
            impact: The unit impulse along the direction.
            world: The direction in world axes, shape (3,).
            label: Suffix of the unknowns' names.
        """
        jump = unknown_jump(case, tree, impact, label)
        return jump, jump.variables, jump.residual

    def guess_direction(self, jump: Vector, support_impulse: Vector, impulse: Vector) -> list[Vector]:
        """The unknowns of :meth:`lift_direction`, given the direction's jump and impulses."""
        return [jump, support_impulse]

    def lift_entry(self, case: ImpactCase, world: ca.SX, one: UnknownJump, other: UnknownJump) -> ca.SX:
        """An entry of ``K``, from two directions' jumps; ``world`` is the first direction."""
        return weighed(case.metric, one, other)

    def form_unit(self, case: ImpactCase, value: Any) -> Any:
        """Size of the form where the objective has ``value``, a number or an expression."""
        return value / self.factor(case)
