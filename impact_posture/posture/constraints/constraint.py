"""Base classes of the constraints on a posture, with CasADi expressions and numeric values from Pinocchio.

To add a constraint, derive from :class:`ExpressionConstraint` and implement ``symbolic`` and ``evaluate``.  If the
constraint has unknowns, derive from :class:`Constraint` and implement ``lift``, ``unknowns``, ``guess``,
``linearize`` and ``evaluate``.  The program, the feasible starts, the certificate and the search for conflicts need
no other methods.
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
    """A constraint in the nonlinear program: ``lower ≤ g(q, z) ≤ upper`` with auxiliary unknowns ``z``.

    Attributes:
        rows: Expression ``g(q, z)``, shape (m, 1).
        variables: Symbols of ``z``, shape (k, 1).
        slack: Sum of the entries of ``z`` that relax rows, m; a penalty drives this sum to zero.
        sides: Further rows that depend only on ``z``, not on ``q``, shape (p, 1).
        pieces: The parts that were joined, for example one for each pair of bodies; the expressions of unchanged
            pieces are reused when the constraint grows.
    """

    rows: ca.SX
    variables: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    slack: ca.SX = field(default_factory=lambda: ca.SX(1, 1))
    sides: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    pieces: tuple[LiftedRows, ...] = ()

    @staticmethod
    def joined(pieces: Sequence[LiftedRows]) -> LiftedRows:
        """Join pieces: first ``rows`` of all pieces, then ``sides`` of all pieces."""
        rows, sides, variables = (
            ca.vertcat(ca.SX(0, 1), *[getattr(piece, key) for piece in pieces])
            for key in ("rows", "sides", "variables")
        )
        slack = sum((piece.slack for piece in pieces), ca.SX(0))
        return LiftedRows(ca.vertcat(rows, sides), variables, slack, pieces=tuple(pieces))


@dataclass(frozen=True, eq=False)
class Linearization:
    """Rows of a constraint, linearized at a posture in the tangent space and in the auxiliary unknowns ``z``.

    Attributes:
        names: Name of each row.
        value: Value of ``g(q, z)``, shape (m,).
        lower, upper: Bounds of the rows, shape (m,).
        posture: Tangent Jacobian ``∂g/∂q``, shape (m, nv).
        auxiliary: Jacobian ``∂g/∂z``, shape (m, k).
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
        """Stack the rows of linearizations that share no auxiliary unknowns."""
        # Omit linearizations without rows; most have none, because most postures are far from most bounds.
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
        name: Name of the constraint in lists of active or conflicting constraints.
        parameters: Numbers that can change without rebuilding the program, for example targets and polygons.
        lower, upper: Bounds, shape (rows,).
        projected: Whether initial postures are projected onto the constraint before the program is solved.
        grows: Whether :meth:`grown` is likely to add rows to the program.
        by_row: Whether a conflict is reported for each row instead of for the whole constraint.
        price: Weight per unit of violation in the search for conflicts.  If constraints conflict, the constraint with
            the lowest weight is violated and therefore reported.
        unit: Unit of a violation in messages.
        at_impact: Whether the constraint concerns only the impact, and not the motion to it.
    """

    name: str
    parameters: Array
    lower: Array
    upper: Array
    projected: bool = True
    grows: bool = False
    by_row: bool = False
    price: float = 1.0
    unit: str = ""
    at_impact: bool = False

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
        """Text that identifies the expressions of the constraint; it is part of the key of the compile cache."""
        return f"{type(self).__name__}:{self.name}:{self.rows}"

    @abstractmethod
    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """Return ``c(q)``, shape (rows,), and its tangent Jacobian, shape (rows, nv), at ``model.q``."""

    def value(self, model: Numeric) -> Array:
        """Return ``c(q)``, shape (rows,); the value needs to be exact only in rows that violate a bound."""
        return self.evaluate(model)[0]

    @abstractmethod
    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """Return the rows for the nonlinear program; ``tree`` is symbolic in chart coordinates."""

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        """Bounds of the rows of :meth:`lift`, shape (m,) each."""
        return self.lower, self.upper

    @property
    def unknowns(self) -> int:
        """Number of auxiliary unknowns ``z``."""
        return 0

    def guess(self, model: Numeric) -> Guess:
        """Return initial values and bounds of the auxiliary unknowns at ``model.q``."""
        return Guess(np.zeros(0), np.zeros(0))

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """Linearize the rows at ``model.q`` and at ``z = auxiliaries``, shape (k,).

        Rows that are far from their bounds may be left out of the result.
        """
        value, jacobian = self.evaluate(model)
        names = [self.row_name(row) for row in range(self.rows)]
        return Linearization(names, value, self.lower, self.upper, jacobian, np.zeros((self.rows, 0)))

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """Return the constraint with the rows that the program lacks at ``model.q``, or ``self`` if none are missing.

        If ``model.q`` is the final posture of a solver run, ``auxiliaries`` is the final ``z``, shape (k,).
        """
        return self

    def slack(self, auxiliaries: Array) -> float:
        """Return the slack, m, for the final ``z = auxiliaries`` of a solver run, shape (k,)."""
        return 0.0

    def excess(self, value: Array) -> Array:
        """Return the signed distance of ``c(q)`` from its bounds, shape (rows,); zero within the bounds."""
        return value - np.clip(value, self.lower, self.upper)

    def conflicts(self, excess: Array) -> dict[str, float]:
        """Return the name of each violated row or constraint with the size of the violation."""
        if self.by_row:
            return {self.row_name(row): abs(float(excess[row])) for row in np.flatnonzero(excess).tolist()}
        return {self.name: float(np.linalg.norm(excess))}

    def size(self, name: str, violation: float) -> str:
        """Return the size of a violation as text; ``name`` and ``violation`` are from :meth:`conflicts`."""
        return f"off by {violation:.3g} {self.unit}".rstrip()

    def describe(self) -> str:
        """Describe the constraint in one line."""
        return f"{self.name} {'held' if self.equality else 'kept within its bounds'}"

    def row_name(self, row: int) -> str:
        """Return the name of a row."""
        return self.name if self.rows == 1 else f"{self.name}[{row}]"

    def pose_error(self, value: Array) -> tuple[float, float]:
        """Return the position error (m) and orientation error (rad) of a held pose; ``value`` is ``c(q)``."""
        return 0.0, 0.0


class ExpressionConstraint(Constraint):
    """Abstract base class of constraints without auxiliary unknowns."""

    @abstractmethod
    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        """Return ``c(q)`` as an expression, shape (rows, 1), at ``tree.q``."""

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        return LiftedRows(self.symbolic(tree, parameters))
