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
    """Return the indices of a row basis of a matrix, shape (k, n), by pivoted Gram-Schmidt.

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
