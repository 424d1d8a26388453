"""A quadratic program in buffers that were sized once, and what solves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# DAQP's constraint types, which we keep as our own.
INEQUALITY, EQUALITY = 0, 5


@dataclass(frozen=True, eq=False)
class QP:
    """``min ½ zᵀHz + gᵀz`` subject to ``lower ≤ [z; A z] ≤ upper``.

    Attributes:
        H: Shape (n, n), symmetric positive definite.
        g: Shape (n,).
        A: Shape (m, n).
        lower: Bounds of the n variables, then of the m rows, shape (n + m,).
        upper: As ``lower``.
        sense: :data:`INEQUALITY` or :data:`EQUALITY` for each of them, shape (n + m,).
    """

    H: Array
    g: Array
    A: Array
    lower: Array
    upper: Array
    sense: NDArray[np.int32]

    @classmethod
    def empty(cls, n: int, m: int) -> QP:
        """A program without cost or bounds."""
        return cls(
            np.eye(n),
            np.zeros(n),
            np.zeros((m, n)),
            np.full(n + m, -np.inf),
            np.full(n + m, np.inf),
            np.zeros(n + m, dtype=np.int32),
        )

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
        """A deep copy."""
        H, g, A = self.H.copy(), self.g.copy(), self.A.copy()
        return QP(H, g, A, self.lower.copy(), self.upper.copy(), self.sense.copy())

    def values(self, z: Array) -> Array:
        """``[z; A z]``, shape (n + m,)."""
        return np.concatenate([z, self.A @ z])

    def violation(self, z: Array) -> float:
        """Largest violation of a bound at ``z``."""
        values = self.values(z)
        return float(max(np.max(self.lower - values), np.max(values - self.upper), 0.0))

    def stationarity(self, z: Array, multipliers: Array) -> float:
        """``‖Hz + g + [I; A]ᵀλ‖_∞``."""
        n = self.n
        return float(np.max(np.abs(self.H @ z + self.g + multipliers[:n] + self.A.T @ multipliers[n:])))


@dataclass(frozen=True, eq=False)
class Solved:
    """A solver's answer.

    Attributes:
        z: Shape (n,).
        multipliers: Of the variables' bounds, then of the rows: positive at the upper bound, shape (n + m,).
        iterations: As the solver counts them.
    """

    z: Array
    multipliers: Array
    iterations: int


class Solver(Protocol):
    """What solves one QP after the other, all of one size."""

    def reset(self) -> None:
        """Forget what earlier solutions left for a warm start."""

    def solve(self, qp: QP) -> Solved | None:
        """The solution, or ``None`` where there is none or none was found (:attr:`infeasible` says which)."""

    @property
    def infeasible(self) -> bool:
        """Whether the last program had no solution, as opposed to: none was found."""
