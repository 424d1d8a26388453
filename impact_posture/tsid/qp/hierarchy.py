"""Lexicographic least squares: each level violates its bounds as little as the more important levels permit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import daqp
import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.qp.quadratic_program import EQUALITY, INEQUALITY

# Bounds are scaled so that no bound exceeds this value, because the tolerances of DAQP are absolute.
_LARGEST = 1e4
# Tolerances within which a row is at its bound, relative to the norm of the row times the norm of z.  The refinement
# uses the first tolerance with which the refined solution is not worse than the solution of DAQP.
_AT = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
# Singular values of rows below this value, relative to the spectral norm, are treated as zero.
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class Level:
    """Rows ``lower ≤ A z ≤ upper`` of one level, with ``A`` of shape (k, n).

    A row with equal bounds is an equation.  An infinite bound does not limit the row.
    """

    A: Array
    lower: Array
    upper: Array


def lexicographic(levels: Sequence[Level], units: Array | float = 1.0) -> Array | None:
    """Return the ``z`` that minimizes the violation of the first level, then of the second level, and so on.

    The violation of a level is the norm of the violations of its rows.  DAQP determines which rows are violated and
    which bounds are reached.  A refinement then treats these rows as equations and gives full precision.

    ``units`` are typical sizes of the variables, shape (n,).  Return ``None`` if the solver failed.
    """
    levels = [level for level in levels if level.lower.size]
    z = _nearest(levels)
    if z is None:
        return None
    y, scaled = z / units, [Level(level.A * units, level.lower, level.upper) for level in levels]
    refined = (_refined(scaled, y, at) for at in _AT)
    best = next((point for point in refined if _no_worse(scaled, point, y)), None)
    y = _onto(scaled[0], y) if best is None else best
    missed = next((k for k, level in enumerate(scaled) if k and not _holds(level, y)), 0)
    if missed:
        whole = _stacked(scaled[: missed + 1])
        if _holds(whole, _onto(whole, y)):
            # DAQP violated a level that is feasible together with the more important levels.  Join this level and the
            # more important levels, and solve again.
            return lexicographic([_stacked(levels[: missed + 1]), *levels[missed + 1 :]], units)
    return np.asarray(units * y)


def _stacked(levels: Sequence[Level]) -> Level:
    return Level(*(np.concatenate([getattr(level, key) for level in levels]) for key in ("A", "lower", "upper")))


def _holds(level: Level, y: Array) -> bool:
    return bool((np.abs(_violation(level, y)) <= _AT[0] * _size(y) * _lengths(level)).all())


def _violation(level: Level, y: Array) -> Array:
    values = level.A @ y
    return np.asarray(values - np.clip(values, level.lower, level.upper))


def _size(y: Array) -> float:
    return max(1.0, float(np.max(np.abs(y))))


def _lengths(level: Level) -> Array:
    lengths = np.linalg.norm(level.A, axis=1)
    return np.where(lengths > 0.0, lengths, 1.0)


def _refined(levels: Sequence[Level], y: Array, near: float) -> Array:
    """Return the exact solution near the approximate solution ``y``.

    Level by level, the function solves for three kinds of rows: equations, violated rows, and rows at a bound.  A row
    that is at its bound at ``y`` stays at this bound in all levels.
    """
    exact, targets, missed = list[Array](), list[Array](), list[tuple[Array, Array]]()
    for k, level in enumerate(levels):
        lengths, values, equal = _lengths(level), level.A @ y, level.lower == level.upper
        at = near * _size(y) * lengths
        low, high = values < level.lower + at, values > level.upper - at
        target = np.where(low, level.lower, level.upper)
        # The rows of the first level are hard, so they can be violated only by rounding errors.
        off = equal | ((low | high) & (np.abs(values - target) > at)) if k else np.zeros_like(equal)
        met = (equal | low | high) & ~off
        exact.append(level.A[met] / lengths[met, None])
        targets.append(target[met] / lengths[met])
        missed.append((level.A[off], target[off]))
    free = np.eye(y.size)
    for A, b in [(np.vstack(exact), np.concatenate(targets)), *missed]:
        if not b.size or not free.shape[1]:
            continue
        U, s, V = np.linalg.svd(A @ free)
        rank = int((s > _RANK * max(1.0, float(np.linalg.norm(A, 2)))).sum())
        y = y + free @ (V[:rank].T @ (U[:, :rank].T @ (b - A @ y) / s[:rank]))
        free = free @ V[rank:].T
    return y


def _no_worse(levels: Sequence[Level], new: Array, old: Array) -> bool:
    for level in levels:
        now, before = (float(np.linalg.norm(_violation(level, y))) for y in (new, old))
        if abs(now - before) > 1e-6 * before + 1e-10 * _size(old) * float(_lengths(level).max()):
            return now < before
    return True


def _onto(level: Level, y: Array) -> Array:
    """Return the point nearest to ``y`` that satisfies the level; return ``y`` if the solver fails."""
    lengths, size = _lengths(level), _size(y)
    A = np.ascontiguousarray(level.A / lengths[:, None])
    high, low = (np.clip((bound / lengths - A @ y) / size, -1e30, 1e30) for bound in (level.upper, level.lower))
    sense = np.where(level.lower == level.upper, EQUALITY, INEQUALITY).astype(np.int32)
    step, _, flag, _ = daqp.solve(np.eye(y.size), np.zeros(y.size), A, high, low, sense, primal_tol=1e-12)
    return y + size * np.asarray(step) if flag > 0 else y


def _nearest(levels: Sequence[Level]) -> Array | None:
    """Return the solution of the hierarchical programs of DAQP, with about six digits; ``None`` if DAQP failed.

    DAQP divides each violation by the length of its row.  Therefore, a rotation (:func:`balanced`) first gives all
    equations of a level the same length.  The rotation does not change the sum of squares.
    """
    blocks = []
    for level in levels:
        equal, rows, low, high = level.lower == level.upper, level.A, level.lower, level.upper
        if equal.all():
            rows, low = balanced(rows, low)
            high = low
        blocks.append((rows, low, high, np.where(equal, EQUALITY, INEQUALITY).astype(np.int32)))
    A, low, high, sense = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    bounds = np.abs(np.concatenate([low, high]))
    scale = max(1.0, float(np.max(bounds, where=np.isfinite(bounds), initial=0.0)) / _LARGEST)
    ends = np.cumsum([level.lower.size for level in levels], dtype=np.int32)
    high, low = (np.clip(bound / scale, -1e30, 1e30) for bound in (high, low))
    z, _, flag, _ = daqp.solve(None, None, np.ascontiguousarray(A), high, low, sense, ends)
    z = scale * np.asarray(z)
    return z if flag > 0 and np.isfinite(z).all() else None


def balanced(A: Array, b: Array) -> tuple[Array, Array]:
    """Return ``QA`` (k, n) and ``Qb`` (k,), where ``Q`` is orthogonal and all rows of ``QA`` have equal length.

    Each rotation combines the shortest and the longest row.  The shortest row then has the root-mean-square length
    (Bendel and Mickey 1978, "Population correlation matrices for sampling experiments").
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
