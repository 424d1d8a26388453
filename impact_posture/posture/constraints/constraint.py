"""Constraints on a posture, each as an expression and in Pinocchio's numbers.

To add a constraint, derive from :class:`ExpressionConstraint` and implement ``symbolic`` and ``evaluate``; with
unknowns of its own, from :class:`Constraint` and implement ``lift``, ``unknowns``, ``guess``, ``linearize`` and
``evaluate``.  The program, the search for feasible starts, the certificate and the elastic diagnosis need nothing
else.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class LiftedRows:
    """A constraint in the unknowns of the program: ``lower ≤ g(q, z) ≤ upper`` with auxiliaries z.

    Attributes:
        rows: ``g(q, z)``, shape (m, 1).
        variables: ``z``, shape (k, 1).
        slack: Sum of those auxiliaries that relax rows, meters; the program drives it to zero.
        sides: More rows, which see only ``z``.
        pieces: The pieces of a constraint that grows.  The expressions of a piece's ``rows`` stay the same object.
    """

    rows: ca.SX
    variables: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    slack: ca.SX = field(default_factory=lambda: ca.SX(1, 1))
    sides: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    pieces: tuple[LiftedRows, ...] = ()

    @staticmethod
    def joined(pieces: Sequence[LiftedRows]) -> LiftedRows:
        """Return pieces as one: the rows of all, then the sides of all."""
        rows, sides, variables = (
            ca.vertcat(ca.SX(0, 1), *[getattr(piece, key) for piece in pieces])
            for key in ("rows", "sides", "variables")
        )
        slack = sum((piece.slack for piece in pieces), ca.SX(0))
        return LiftedRows(ca.vertcat(rows, sides), variables, slack, pieces=tuple(pieces))


@dataclass(frozen=True, eq=False)
class Linearization:
    """Rows of a constraint near a posture, over the tangent space and the auxiliaries that the certificate keeps.

    Attributes:
        names: Name of each row.
        value: ``g(q, z)``, shape (m,).
        lower: Lower bounds, shape (m,).
        upper: Upper bounds, shape (m,).
        posture: Tangent Jacobian ``∂g/∂q``, shape (m, nv).
        auxiliary: ``∂g/∂z``, shape (m, k).
    """

    names: list[str]
    value: Array
    lower: Array
    upper: Array
    posture: Array
    auxiliary: Array

    @staticmethod
    def joined(parts: Sequence[Linearization], nv: int) -> Linearization:
        """Return the rows of several parts, each with auxiliaries of its own."""
        # Most postures are far from most bounds.
        parts = [part for part in parts if part.names or part.auxiliary.shape[1]]
        if len(parts) == 1:
            return parts[0]
        ends = np.cumsum([0, *[part.auxiliary.shape[1] for part in parts]])
        auxiliary = np.zeros((sum(len(part.names) for part in parts), ends[-1]))
        row = 0
        for part, start, stop in zip(parts, ends[:-1], ends[1:], strict=True):
            auxiliary[row : row + len(part.names), start:stop] = part.auxiliary
            row += len(part.names)
        empty = np.zeros(0)
        value, lower, upper = (
            np.concatenate([empty, *[getattr(part, key) for part in parts]]) for key in ("value", "lower", "upper")
        )
        posture = np.vstack([np.zeros((0, nv)), *[part.posture for part in parts]])
        return Linearization([name for part in parts for name in part.names], value, lower, upper, posture, auxiliary)


class Constraint(ABC):
    """Abstract base of constraints ``lower ≤ c(q) ≤ upper``, which are equalities if both bounds are equal.

    Attributes:
        name: Name in lists of active and of conflicting constraints.
        parameters: Numbers that may change without rebuilding the program (targets, polygons).
        lower: Lower bounds, shape (rows,).
        upper: Upper bounds, shape (rows,).
        projected: Whether starts are pulled onto it; else the program alone satisfies it.
        grows: Whether its program is likely to grow by :meth:`grown`.
        price: Price of a violation of a row where constraints conflict; a cheap one gives way, and is named.
    """

    name: str
    parameters: Array
    lower: Array
    upper: Array
    projected: bool = True
    grows: bool = False
    price: float = 1.0

    @property
    def rows(self) -> int:
        """Number of scalar constraints on ``c(q)``."""
        return int(self.lower.size)

    @property
    def equality(self) -> bool:
        """Whether the constraint is an equality."""
        return bool((self.lower == self.upper).all())

    @property
    def structure(self) -> str:
        """Text that distinguishes it apart from parameters and bounds; part of the key of the compile cache."""
        return f"{type(self).__name__}:{self.name}:{self.rows}"

    @abstractmethod
    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """Return ``c(q)``, shape (rows,), and its tangent Jacobian, shape (rows, nv), at ``model.q``."""

    def value(self, model: Numeric) -> Array:
        """Return ``c(q)`` alone; exact where it violates a bound."""
        return self.evaluate(model)[0]

    # ---- lifted form, by default without auxiliaries ----------------------------------------------------------

    @abstractmethod
    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """Return the rows of the program with their auxiliaries, of a ``tree`` that was built with ``chart_x``."""

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        """Bounds of the rows of :meth:`lift`, shape (m,) each."""
        return self.lower, self.upper

    @property
    def unknowns(self) -> int:
        """Number of auxiliaries."""
        return 0

    def guess(self, model: Numeric) -> Guess:
        """Return the auxiliaries to start from at ``model.q``, with their bounds."""
        return Guess(np.zeros(0), np.zeros(0))

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """Return the rows at ``model.q`` in Pinocchio's numbers; those far from their bounds may be left out.

        Args:
            model: The model at the posture.
            auxiliaries: Values of the auxiliaries of :meth:`lift`, shape (k,).
        """
        value, jacobian = self.evaluate(model)
        names = [self.row_name(row) for row in range(self.rows)]
        return Linearization(names, value, self.lower, self.upper, jacobian, np.zeros((self.rows, 0)))

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """Return the constraint with the parts that its program lacks at ``model.q``; itself if it lacks none.

        Args:
            model: The model at the posture.
            auxiliaries: The auxiliaries of the program there, if the posture is the end of a run, shape (k,).
        """
        return self

    def slack(self, auxiliaries: Array) -> float:
        """Return by how much (m) a run was let off where it ended; zero without slack.

        Args:
            auxiliaries: The auxiliaries of the program at the end, shape (k,).
        """
        return 0.0

    # ---- words ------------------------------------------------------------------------------------------------

    def excess(self, value: Array) -> Array:
        """Return how far ``c(q)`` lies outside its bounds, signed, shape (rows,)."""
        return value - np.clip(value, self.lower, self.upper)

    def conflicts(self, excess: Array) -> dict[str, float]:
        """Return names of what is violated, and by how much."""
        return {self.name: float(np.linalg.norm(excess))}

    def describe(self) -> str:
        """Describe the constraint in one line."""
        return f"{self.name} {'held' if self.equality else 'kept within its bounds'}"

    def row_name(self, row: int) -> str:
        """Return the name of a row."""
        return self.name if self.rows == 1 else f"{self.name}[{row}]"

    def pose_error(self, value: Array) -> tuple[float, float]:
        """Return the error of a held pose in meters and radians where ``c(q)`` is ``value``; zeros without a pose."""
        return 0.0, 0.0


class ExpressionConstraint(Constraint):
    """Abstract base of constraints that are an expression of the posture alone."""

    @abstractmethod
    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """Return ``c(q)`` as an expression, shape (rows, 1), of a ``tree`` that was built with ``chart_x``."""

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """See :class:`Constraint`."""
        return LiftedRows(self.symbolic(tree, parameters))
