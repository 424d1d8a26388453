"""Strict levels of any rank: dependent rows leave a tick's formulation, nearly dependent ones are damped."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impact_posture.tsid.qp import EQUALITY, INEQUALITY, QP

Array = NDArray[np.float64]

# Singular values of a level's rows, over the length of its longest row, below which a direction is damped.  In their
# postures the shipped robots stay above 0.03.
SINGULAR = 2e-2
# Share of that below which a direction is dropped: far above rounding, far below what could be seen.
_NOTHING = 1e-9
# Least 1 − α: a damped row's weight stays within the solver's digits.
_LEAST = 1e-8


class LevelRank:
    """Keeps the strict levels of a program independent of each other and of the dynamics.

    A level with rows ``J`` acts in what the levels above leave, with the basis ``Z``: ``J Z = U S Vᵀ``.  Its rows are
    turned by ``Uᵀ``, which changes no sum of squares; each then belongs to one singular value ``s``.  With
    ``x = s/s₀``, where ``s₀`` is :data:`SINGULAR` times the length of the level's longest row:

    - ``x ≥ 1``: the row is an equation, as asked for;
    - ``x = 0``: the levels above determine the row already, or it contradicts its own level.  It leaves the program.
      With the others held that is the level's least-squares answer, which is exact where the rows agree;
    - between: the row is damped.  It moves into the cost as ``α/(1 − α) (q·ν̇ − c/s)²`` with ``α = x²(3 − 2x)`` and
      the direction ``q`` that it asks to move in, beside ``x (q·ν̇)²``; both have the mean weight of the cost.  This
      fades from an equation to nothing, so that accelerations are continuous through a singular posture.  They are at
      most ``3/s₀`` times what the row asks for.  The levels below have ``√(1 − α)`` of the direction.

    All of this is a function of the present rows; only their lengths are those at reset.  There is no hysteresis.
    While all rows are independent, the program is the given one.  That is known without a decomposition a tick,
    because no singular value moves further than the matrix does (Weyl 1912).

    Attributes:
        qp: The program to solve.
        wanted: Right-hand sides of the first rows of ``qp.A``, also of those that are no equations.
        changed: Whether other rows are equations than at the last :meth:`update`.
    """

    def __init__(self, qp: QP, always: int, levels: Sequence[slice], accelerations: int, units: Array) -> None:
        """Size the buffers.

        Args:
            qp: The formulation, in its buffers.
            always: How many rows always hold; they are the first.
            levels: Rows of each level, next to each other behind those.
            accelerations: How many variables the levels are about; they are the first.
            units: What compares with an acceleration of one, for each variable, shape (n,).
        """
        self._given, self._always, self._levels = qp, always, tuple(levels)
        self._accelerations, self._units = accelerations, units
        self._count = self._levels[-1].stop if levels else 0
        self._rows = qp.A[: self._count]
        self._reference, self._way = np.zeros(self._rows.shape), np.zeros(self._rows.shape)
        self._flat = self._way.reshape(-1)
        self._asked = qp.lower[qp.n : qp.n + self._count]
        self.qp, self.changed, self.wanted = qp, False, self._asked
        self.reset()

    def reset(self) -> None:
        """Take the lengths of the rows anew at the next :meth:`update`."""
        self._begun = False

    def update(self) -> None:
        """Look at the rows that are in the program now."""
        if not self._count:
            return
        if not self._begun:
            self._begin()
        way = self._way
        np.subtract(self._rows, self._reference, out=way)
        way *= self._scale
        # Not ">=": that is false for a NaN.
        if not self._flat.dot(self._flat) < self._room:
            self._measure()
        before = self.qp
        if self._independent:
            self.qp, self.wanted = self._given, self._asked
        else:
            self.qp = self._reduced()
        self.changed = self.qp is not before and not np.array_equal(self.qp.sense, before.sense)

    def rows(self, rows: slice, equations: bool) -> NDArray[np.intp]:
        """Those rows of a level that are equations, or those that are not."""
        n = self._given.n
        held = self.qp.sense[n + rows.start : n + rows.stop] == EQUALITY
        return np.asarray(np.arange(rows.start, rows.stop)[held == equations])

    def _begin(self) -> None:
        lengths = np.linalg.norm(self._rows * self._units, axis=1)
        for level in self._levels:
            lengths[level] = lengths[level].max()
        lengths[lengths == 0.0] = 1.0
        self._lengths, self._scale, self._begun = lengths, self._units / lengths[:, None], True
        self._measure()

    def _measure(self) -> None:
        """The least singular value of all rows together: no level has a smaller one in what those above leave."""
        self._reference[:] = self._rows
        self._independent, self._room = True, 0.0
        if np.isfinite(self._rows).all():
            values = np.linalg.svd(self._rows * self._scale, compute_uv=False)
            least = float(values[-1]) if self._count <= self._given.n else 0.0
            self._independent, self._room = least >= SINGULAR, (least - SINGULAR) ** 2

    def _reduced(self) -> QP:
        given, lengths = self._given, self._lengths
        n = given.n
        qp = QP(given.H, given.g, given.A.copy(), given.lower.copy(), given.upper.copy(), given.sense.copy())
        self.wanted = self._asked.copy()
        Z = np.diag(self._units)
        if self._always:
            Z = Z @ np.linalg.svd((self._rows * self._scale)[: self._always])[2][self._always :].T
        for rows in self._levels:
            U, s, Vt = np.linalg.svd(given.A[rows] @ Z)
            qp.A[rows], self.wanted[rows] = U.T @ given.A[rows], U.T @ self.wanted[rows]
            x = np.zeros(max(U.shape[0], Vt.shape[0]))
            x[: s.size] = np.minimum(s / (SINGULAR * lengths[rows.start]), 1.0)
            held = x[: U.shape[0]] == 1.0
            at = slice(n + rows.start, n + rows.stop)
            qp.sense[at] = np.where(held, EQUALITY, INEQUALITY)
            qp.lower[at] = np.where(held, self.wanted[rows], -np.inf)
            qp.upper[at] = np.where(held, self.wanted[rows], np.inf)
            alpha = x * x * (3.0 - 2.0 * x)
            directions = Z @ Vt.T
            damped = np.flatnonzero((x > _NOTHING) & (x < 1.0))
            if damped.size:
                weight = _mean_weight(given.H, Z, self._accelerations)
                strength = weight * alpha[damped] / np.maximum(1.0 - alpha[damped], _LEAST) / s[damped] ** 2
                J, c = qp.A[rows][damped], self.wanted[rows][damped]
                q = np.zeros((n, damped.size))
                q[: self._accelerations] = directions[: self._accelerations, damped]
                H = qp.H + (J.T * strength) @ J + (q * (weight * x[damped])) @ q.T
                qp = QP(H, qp.g - (strength * c) @ J, qp.A, qp.lower, qp.upper, qp.sense)
            Z = (directions * np.sqrt(1.0 - alpha[: Z.shape[1]]))[:, x[: Z.shape[1]] < 1.0]
        return qp


def _mean_weight(H: Array, Z: Array, count: int) -> float:
    """Of the cost, over the directions ``Z`` that are left."""
    Z = Z[:count]
    return float(np.sum(Z * (H[:count, :count] @ Z)) / np.sum(Z * Z))
