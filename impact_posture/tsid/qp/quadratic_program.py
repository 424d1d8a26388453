"""Quadratic program with buffers that are allocated once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from impact_posture.system.arrays import Array

# Codes of DAQP for the types of constraints.
INEQUALITY, EQUALITY = 0, 5


@dataclass(frozen=True, eq=False)
class QP:
    """``min ½ zᵀHz + gᵀz`` subject to ``lower ≤ [z; A z] ≤ upper``.

    Attributes:
        H: Hessian of the cost, symmetric positive definite, shape (n, n).
        g: Gradient of the cost at zero, shape (n,).
        A: Rows of the constraints, shape (m, n).
        lower: Lower bounds of the n variables, then of the m rows, shape (n + m,).
        upper: Upper bounds in the same order, shape (n + m,).
        sense: :data:`INEQUALITY` or :data:`EQUALITY` for each variable and row, shape (n + m,).
    """

    H: Array
    g: Array
    A: Array
    lower: Array
    upper: Array
    sense: NDArray[np.int32]

    @classmethod
    def empty(cls, n: int, m: int) -> QP:
        """Return a program with the identity as Hessian, zero rows and infinite bounds."""
        lower, sense = np.full(n + m, -np.inf), np.zeros(n + m, dtype=np.int32)
        return cls(np.eye(n), np.zeros(n), np.zeros((m, n)), lower, -lower, sense)

    @property
    def n(self) -> int:
        """Number of variables."""
        return self.g.size

    @property
    def m(self) -> int:
        """Number of rows."""
        return int(self.A.shape[0])

    @property
    def finite(self) -> bool:
        """Whether cost and rows are finite and no bound is NaN."""
        sums = self.H.sum() + self.g.sum() + self.A.sum()
        return bool(np.isfinite(sums) and not np.isnan(self.lower).any() and not np.isnan(self.upper).any())

    def copy(self) -> QP:
        """Return a deep copy."""
        return QP(*(getattr(self, field.name).copy() for field in fields(self)))

    def values(self, z: Array) -> Array:
        """Return ``[z; A z]``, shape (n + m,)."""
        return np.concatenate([z, self.A @ z])

    def violation(self, z: Array) -> float:
        """Return the largest violation of a bound at ``z``."""
        values = self.values(z)
        return float(max(np.max(self.lower - values), np.max(values - self.upper), 0.0))


@dataclass(frozen=True, eq=False)
class Solved:
    """Solution of a quadratic program.

    Attributes:
        z: Values of the variables, shape (n,).
        multipliers: Multipliers of the variables' bounds, then of the rows, shape (n + m,); positive at upper bounds.
        iterations: Number of iterations, as the solver counts them.
    """

    z: Array
    multipliers: Array
    iterations: int


def stacked_rows(sizes: Iterable[int]) -> tuple[tuple[slice, ...], int]:
    """Return a slice of rows for each of the stacked blocks with ``sizes`` rows, and the total number of rows."""
    ends = list(accumulate(sizes, initial=0))
    return tuple(slice(start, stop) for start, stop in pairwise(ends)), ends[-1]
