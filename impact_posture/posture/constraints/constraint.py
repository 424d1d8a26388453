"""Base classes of the constraints on a posture, which CasADi sees as expressions and Pinocchio as numbers.

To add a constraint, derive from :class:`ExpressionConstraint` and implement ``symbolic`` and ``evaluate``.  If it has
unknowns, derive from :class:`Constraint` and implement ``lift``, ``unknowns``, ``guess``, ``linearize`` and
``evaluate``.  The program, the feasible starts, the certificate and the search for conflicts need nothing else.
"""

from __future__ import annotations

import hashlib
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


def digest(*parts: object) -> str:
    """Return a short hash of arrays and texts, for :attr:`Constraint.structure`."""
    content = b"".join(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode() for part in parts)
    return hashlib.sha256(content).hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class LiftedRows:
    """A constraint in the unknowns of the program: ``lower ≤ g(q, z) ≤ upper`` with auxiliaries z.

    Attributes:
        rows: ``g(q, z)``, shape (m, 1).
        variables: ``z``, shape (k, 1).
        slack: Sum of the auxiliaries that relax rows, meters; the program drives it to zero.
        sides: More rows, which depend on ``z`` alone.
        pieces: Pieces of a constraint that grows.  ``rows`` of a piece stays the same object.
    """

    rows: ca.SX
    variables: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    slack: ca.SX = field(default_factory=lambda: ca.SX(1, 1))
    sides: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    pieces: tuple[LiftedRows, ...] = ()

    @staticmethod
    def joined(pieces: Sequence[LiftedRows]) -> LiftedRows:
        """Join pieces: the rows of all, then the sides of all."""
        rows, sides, variables = (
            ca.vertcat(ca.SX(0, 1), *[getattr(piece, key) for piece in pieces])
            for key in ("rows", "sides", "variables")
        )
        slack = sum((piece.slack for piece in pieces), ca.SX(0))
        return LiftedRows(ca.vertcat(rows, sides), variables, slack, pieces=tuple(pieces))


@dataclass(frozen=True, eq=False)
class Linearization:
    """Rows of a constraint near a posture, over the tangent space and the auxiliaries of the certificate.

    Attributes:
        names: Name of each row.
        value: ``g(q, z)``, shape (m,).
        lower, upper: Bounds, shape (m,).
        posture: Tangent Jacobian ``∂g/∂q``, shape (m, nv).
        auxiliary: ``∂g/∂z``, shape (m, k).
    """

    names: list[str]
    value: Array
    lower: Array
    upper: Array
    posture: Array
    auxiliary: Array

    @property
    def violation(self) -> float:
        """Largest violation of a bound; zero if all rows are within their bounds."""
        return float(np.maximum(self.lower - self.value, self.value - self.upper).max(initial=0.0))

    @staticmethod
    def joined(parts: Sequence[Linearization], nv: int) -> Linearization:
        """Join the rows of parts whose auxiliaries are separate."""
        # Most parts are empty, because most postures are far from most bounds.
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
    """Abstract base class of constraints ``lower ≤ c(q) ≤ upper``.

    A constraint is an equality if both bounds are equal.

    Attributes:
        name: Name in lists of active and of conflicting constraints.
        parameters: Numbers that may change without rebuilding the program (targets, polygons).
        lower, upper: Bounds, shape (rows,).
        projected: Whether starts are pulled onto the constraint; else the program alone satisfies it.
        grows: Whether :meth:`grown` is likely to add parts to the program.
        by_row: Whether conflicts name each row instead of the constraint.
        price: Price of a violation where constraints conflict.  A cheap constraint gives way, and is named.
    """

    name: str
    parameters: Array
    lower: Array
    upper: Array
    projected: bool = True
    grows: bool = False
    by_row: bool = False
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
        """Text that identifies the expressions, part of the key of the compile cache."""
        return f"{type(self).__name__}:{self.name}:{self.rows}"

    @abstractmethod
    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """Return ``c(q)``, shape (rows,), and its tangent Jacobian, shape (rows, nv), at ``model.q``."""

    def value(self, model: Numeric) -> Array:
        """Return ``c(q)``, which needs to be exact only where it violates a bound."""
        return self.evaluate(model)[0]

    # ---- lifted form, by default without auxiliaries ----------------------------------------------------------

    @abstractmethod
    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """Return the rows of the program with their auxiliaries; ``tree`` is built with ``chart_x``."""

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
        """Return the rows at ``model.q`` and auxiliaries, shape (k,); rows far from their bounds may be left out."""
        value, jacobian = self.evaluate(model)
        names = [self.row_name(row) for row in range(self.rows)]
        return Linearization(names, value, self.lower, self.upper, jacobian, np.zeros((self.rows, 0)))

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """Return the constraint with the parts that its program lacks at ``model.q``, or itself if none are missing.

        If the posture is the end of a run, ``auxiliaries`` are the values of the program there, shape (k,).
        """
        return self

    def slack(self, auxiliaries: Array) -> float:
        """Return the slack (m) in the auxiliaries of :meth:`lift`, shape (k,), at the end of a run."""
        return 0.0

    def excess(self, value: Array) -> Array:
        """Return how far ``c(q)`` lies outside its bounds, signed, shape (rows,)."""
        return value - np.clip(value, self.lower, self.upper)

    def conflicts(self, excess: Array) -> dict[str, float]:
        """Return the names of what is violated, with the size of each violation."""
        if self.by_row:
            return {self.row_name(row): abs(float(excess[row])) for row in np.flatnonzero(excess).tolist()}
        return {self.name: float(np.linalg.norm(excess))}

    def describe(self) -> str:
        """Describe the constraint in one line."""
        return f"{self.name} {'held' if self.equality else 'kept within its bounds'}"

    def row_name(self, row: int) -> str:
        """Return the name of a row."""
        return self.name if self.rows == 1 else f"{self.name}[{row}]"

    def pose_error(self, value: Array) -> tuple[float, float]:
        """Return the position (m) and orientation error (rad) of a held pose where ``c(q)`` is ``value``."""
        return 0.0, 0.0


class ExpressionConstraint(Constraint):
    """Abstract base class of constraints that are an expression of the posture alone."""

    @abstractmethod
    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """Return ``c(q)`` as an expression, shape (rows, 1); ``tree`` is built with ``chart_x``."""

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        return LiftedRows(self.symbolic(tree, parameters))
