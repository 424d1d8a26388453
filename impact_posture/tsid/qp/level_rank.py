"""Strict levels of any rank: dependent rows are removed from the QP, and nearly dependent rows are damped."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impact_posture.system.arrays import Array
from impact_posture.tsid.qp.quadratic_program import EQUALITY, INEQUALITY, QP
from impact_posture.tsid.smooth_step import smooth

# A direction is damped if its singular value, divided by the length of the level's longest row, is smaller than this.
# In the home postures of all shipped robots, this ratio is above 0.03.
SINGULAR = 2e-2
# Directions are removed if their ratio (see ``SINGULAR``) is below this fraction of ``SINGULAR``.  ``DROPPED`` is far
# above rounding errors, but too small for a visible effect.
DROPPED = 1e-9
# Least ``1 − α``, which limits the weight ``α/(1 − α)`` of a damped row.
LEAST = 1e-8


class LevelRank:
    """Keep the strict levels of a QP independent of each other and of the dynamics.

    A level with rows ``J`` acts in the space that the more important levels leave free.  ``Z`` is a basis of this
    space, and ``J Z = U S Vᵀ``.  The rows are rotated by ``Uᵀ``, which does not change the sum of squares.  Each
    rotated row then belongs to one singular value ``s``.  ``s₀`` is :data:`SINGULAR` times the length of the level's
    longest row.  With ``x = s/s₀``:

    - ``x ≥ 1``: the row is an equation.
    - ``x = 0``: more important levels determine the row, or the row contradicts other rows of its level.  The row is
      removed from the QP.  The other rows of the level give its least-squares solution.
    - Otherwise, the row is damped: it becomes a term ``α/(1 − α) (q·ν̇ − c/s)² + x (q·ν̇)²`` of the cost, with
      ``α = x²(3 − 2x)``.  ``q = Zv`` is the row's direction of motion (not the configuration), where ``v`` is
      the column of ``V`` that belongs to ``s``.  ``c`` is the row's right-hand side.  The term is multiplied by the
      mean weight of the accelerations in the cost.  With decreasing ``x``, the influence of the row decreases
      smoothly to zero, so accelerations are continuous through a singular posture.  The row causes accelerations of
      at most ``3c/s₀``.  The less important levels act along this direction with the factor ``√(1 − α)``.

    The result depends only on the present rows and on their lengths at reset.  While all rows are independent, all of
    them remain equations.  A singular value changes at most by the norm of the change of the matrix (Weyl 1912), so
    most ticks detect independent rows without a decomposition.

    Attributes:
        qp: The QP to solve.
        wanted: Right-hand sides of the rows of the levels, also for rows that are not equations.
        units: Typical size of each variable if an acceleration has the size 1, shape (n,).
        changed: Whether the last :meth:`update` changed the set of equations.
    """

    def __init__(self, qp: QP, always: int, levels: Sequence[slice], accelerations: int, units: Array) -> None:
        """Size the buffers.

        ``qp`` is the QP with all rows.  The first ``always`` rows of ``qp`` are always equations; the rows of the
        ``levels`` follow.  The first ``accelerations`` variables are accelerations.
        """
        self._full, self._always, self._levels = qp, always, tuple(levels)
        self._accelerations, self.units = accelerations, units
        self._count = self._levels[-1].stop if levels else 0
        self._rows = qp.A[: self._count]
        self._reference, self._moved = np.zeros(self._rows.shape), np.zeros(self._rows.shape)
        self._flat = self._moved.reshape(-1)
        self._demanded = qp.lower[qp.n : qp.n + self._count]
        self.qp, self.changed, self.wanted = qp, False, self._demanded
        self.reset()

    def reset(self) -> None:
        """Measure the lengths of the rows again at the next :meth:`update`."""
        self._begun = False

    def update(self) -> None:
        """Update the QP for the current values of the rows."""
        if not self._count:
            return
        if not self._begun:
            self._begin()
        moved = self._moved
        np.subtract(self._rows, self._reference, out=moved)
        moved *= self._scale
        # The test is "not <" instead of ">=", because ">=" is false for NaN.
        if not self._flat.dot(self._flat) < self._room:
            self._measure()
        before = self.qp
        if self._independent:
            self.qp, self.wanted = self._full, self._demanded
        else:
            self.qp = self._reduced()
        self.changed = self.qp is not before and not np.array_equal(self.qp.sense, before.sense)

    def rows(self, rows: slice, equations: bool) -> NDArray[np.intp]:
        """Return the rows of a level that are equations; if ``equations`` is false, return the other rows."""
        n = self._full.n
        held = self.qp.sense[n + rows.start : n + rows.stop] == EQUALITY
        return np.asarray(np.arange(rows.start, rows.stop)[held == equations])

    def _begin(self) -> None:
        lengths = np.linalg.norm(self._rows * self.units, axis=1)
        for level in self._levels:
            lengths[level] = lengths[level].max()
        lengths[lengths == 0.0] = 1.0
        self._lengths, self._scale, self._begun = lengths, self.units / lengths[:, None], True
        self._measure()

    def _measure(self) -> None:
        """Compute the smallest singular value of all rows, a lower bound on the singular values of all levels."""
        self._reference[:] = self._rows
        self._independent, self._room = True, 0.0
        if np.isfinite(self._rows).all():
            values = np.linalg.svd(self._rows * self._scale, compute_uv=False)
            least = float(values[-1]) if self._count <= self._full.n else 0.0
            self._independent, self._room = least >= SINGULAR, (least - SINGULAR) ** 2

    def _reduced(self) -> QP:
        lengths, n, qp = self._lengths, self._full.n, self._full.copy()
        self.wanted = self._demanded.copy()
        Z = np.diag(self.units)
        if self._always:
            Z = Z @ np.linalg.svd((self._rows * self._scale)[: self._always])[2][self._always :].T
        for rows in self._levels:
            U, s, Vt = np.linalg.svd(self._full.A[rows] @ Z)
            qp.A[rows], self.wanted[rows] = U.T @ self._full.A[rows], U.T @ self.wanted[rows]
            x = np.zeros(max(U.shape[0], Vt.shape[0]))
            x[: s.size] = np.minimum(s / (SINGULAR * lengths[rows.start]), 1.0)
            held = x[: U.shape[0]] == 1.0
            at = slice(n + rows.start, n + rows.stop)
            qp.sense[at] = np.where(held, EQUALITY, INEQUALITY)
            qp.lower[at] = np.where(held, self.wanted[rows], -np.inf)
            qp.upper[at] = np.where(held, self.wanted[rows], np.inf)
            alpha = smooth(x)
            directions = Z @ Vt.T
            damped = np.flatnonzero((x > DROPPED) & (x < 1.0))
            if damped.size:
                weight = _mean_weight(self._full.H, Z, self._accelerations)
                strength = weight * alpha[damped] / np.maximum(1.0 - alpha[damped], LEAST) / s[damped] ** 2
                J, c = qp.A[rows][damped], self.wanted[rows][damped]
                q = np.zeros((n, damped.size))
                q[: self._accelerations] = directions[: self._accelerations, damped]
                H = qp.H + (J.T * strength) @ J + (q * (weight * x[damped])) @ q.T
                qp = QP(H, qp.g - (strength * c) @ J, qp.A, qp.lower, qp.upper, qp.sense)
            Z = (directions * np.sqrt(1.0 - alpha[: Z.shape[1]]))[:, x[: Z.shape[1]] < 1.0]
        return qp


def _mean_weight(H: Array, Z: Array, count: int) -> float:
    Z = Z[:count]
    return float(np.sum(Z * (H[:count, :count] @ Z)) / np.sum(Z * Z))
