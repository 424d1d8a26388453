"""The array type of signatures, and linear algebra without the slow import of SciPy."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def null_space(rows: Array, tolerance: float) -> Array:
    """Return an orthonormal basis of the null space of a matrix of shape (k, n), as columns, shape (n, r).

    Singular values up to ``tolerance`` times the largest count as zero.  The import of SciPy, which has the same
    function, takes longer than many problems take to solve.
    """
    _, values, axes = np.linalg.svd(rows)
    return np.asarray(axes[int((values > tolerance * values.max(initial=0.0)).sum()) :].T)


def independent_rows(rows: Array, tolerance: float) -> list[int]:
    """Return the indices of independent rows of shape (k, n) that span all rows, by pivoted Gram-Schmidt.

    A row is dependent if its remainder after projection is at most ``tolerance``.
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
