"""Lexicographic least squares: each level comes as near to its bounds as the levels above permit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import numpy as np

from impact_posture.arrays import Array
from impact_posture.tsid.qp import EQUALITY, INEQUALITY

# Bounds are scaled below this, because the tolerances of DAQP are absolute.
_LARGEST = 1e4


@dataclass(frozen=True, eq=False)
class Level:
    """Rows ``lower ≤ A z ≤ upper`` of one level; equal bounds make equations.

    Attributes:
        A: Shape (k, n).
        lower: Shape (k,); may be minus infinity.
        upper: Shape (k,); may be infinity.
    """

    A: Array
    lower: Array
    upper: Array


def lexicographic(levels: Sequence[Level]) -> Array | None:
    """Return the ``z`` that violates the first level least, then the second, and so on (least squares).

    The hierarchical programs of DAQP have a solution for all bounds.  DAQP measures a violation in units of the row's
    length.  The equations of a level are therefore rotated among themselves (:func:`balanced`) until all its rows
    have the same length, which does not change the sum of squares.

    Returns:
        Shape (n,), to about six digits; ``None`` if the solver gave up.
    """
    given = [level for level in levels if level.lower.size]
    blocks = []
    for level in given:
        equal, rows, low, high = level.lower == level.upper, level.A, level.lower, level.upper
        if equal.all():
            rows, low = balanced(rows, low)
            high = low
        blocks.append((rows, low, high, np.where(equal, EQUALITY, INEQUALITY).astype(np.int32)))
    A, low, high, sense = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    bounds = np.abs(np.concatenate([low, high]))
    scale = max(1.0, float(np.max(bounds, where=np.isfinite(bounds), initial=0.0)) / _LARGEST)
    ends = np.cumsum([level.lower.size for level in given], dtype=np.int32)
    z, _, flag, _ = daqp.solve(
        None,
        None,
        np.ascontiguousarray(A),
        np.clip(high / scale, -1e30, 1e30),
        np.clip(low / scale, -1e30, 1e30),
        sense,
        ends,
    )
    z = scale * np.asarray(z)
    return z if flag > 0 and np.isfinite(z).all() else None


def balanced(A: Array, b: Array) -> tuple[Array, Array]:
    """Return ``QA`` and ``Qb`` with an orthogonal ``Q`` that makes all rows of ``QA`` equally long.

    Each rotation combines the shortest and the longest row and gives the shortest row the mean length
    (Bendel and Mickey 1978, "Population correlation matrices for sampling experiments").

    Args:
        A: Shape (k, n).
        b: Shape (k,).
    """
    A, b = A.copy(), b.copy()
    mean = float(np.sum(A * A)) / max(b.size, 1)
    for _ in range(b.size - 1):
        excess = np.sum(A * A, axis=1) - mean
        i, j = int(excess.argmin()), int(excess.argmax())
        if not (excess[i] < -1e-12 * mean and excess[j] > 1e-12 * mean):
            break
        along = A[i] @ A[j]
        t = (-along + np.sqrt(along * along - excess[i] * excess[j])) / excess[j]
        c, s = 1.0 / np.hypot(1.0, t), t / np.hypot(1.0, t)
        turn = np.array([[c, s], [-s, c]])
        A[[i, j]], b[[i, j]] = turn @ A[[i, j]], turn @ b[[i, j]]
    return A, b
