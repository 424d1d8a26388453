"""Array type for annotations, and linear algebra functions that do not need the slow import of SciPy."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def null_space(rows: Array, tolerance: float) -> Array:
    """Return an orthonormal basis of the null space of a matrix of shape (k, n), as columns, shape (n, r).

    Singular values up to ``tolerance`` times the largest are treated as zero.  SciPy has the same function, but
    importing SciPy takes longer than solving a typical problem.
    """
    _, values, axes = np.linalg.svd(rows)
    return np.asarray(axes[int((values > tolerance * values.max(initial=0.0)).sum()) :].T)


def independent_rows(rows: Array, tolerance: float) -> list[int]:
    """Return the indices of independent rows of a matrix, shape (k, n), by pivoted Gram-Schmidt.

    A row is dependent if its distance from the span of the chosen rows is at most ``tolerance``.
    """
    left, chosen = np.array(rows, dtype=float), list[int]()
    for _ in range(len(left)):
        sizes = np.linalg.norm(left, axis=1)
        k = int(sizes.argmax())
        if sizes[k] <= tolerance:
            break
        left -= np.outer(left @ left[k], left[k]) / sizes[k] ** 2
        left[k] = 0.0
        chosen.append(k)
    return sorted(chosen)


def nonnegative_least_squares(matrix: Array, right: Array) -> Array:
    """Return the ``x ≥ 0`` that minimizes ``‖A x − b‖`` (Lawson and Hanson 1974, algorithm NNLS).

    This function replaces ``scipy.optimize.nnls``, whose import takes 0.35 s.  An optimization of a small robot takes
    only 0.6 s in total (CPU times). For the 831 certificates of the tests, the residuals of both functions differ by
    at most 6e-10; a certificate allows 1e-6.
    """
    x, passive = np.zeros(matrix.shape[1]), np.zeros(matrix.shape[1], dtype=bool)
    least = 10 * max(matrix.shape) * np.finfo(float).eps * float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    # Rounding errors can cause endless cycles, so the number of rounds is limited.  Three rounds per unknown are more
    # than the algorithm normally needs.
    for _ in range(3 * len(x)):
        slope = np.where(passive, -np.inf, matrix.T @ (right - matrix @ x))
        if passive.all() or slope.max() <= least:
            break
        passive[slope.argmax()] = True
        while (trial := _unbounded(matrix, right, passive))[passive].min(initial=np.inf) <= 0:
            # Move towards the trial solution until the first entry becomes zero, and keep this entry at zero.
            falling = passive & (trial <= 0)
            step = (x[falling] / np.maximum(x[falling] - trial[falling], np.finfo(float).tiny)).min()
            x += step * (trial - x)
            passive &= x > least
        x = trial
    return x


def _unbounded(matrix: Array, right: Array, passive: NDArray[np.bool_]) -> Array:
    x = np.zeros(len(passive))
    x[passive] = np.linalg.lstsq(matrix[:, passive], right, rcond=None)[0]
    return x
