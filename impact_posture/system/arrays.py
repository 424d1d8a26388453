"""The type of the arrays of numbers in signatures, and linear algebra that SciPy takes long to import."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def null_space(rows: Array, tolerance: float) -> Array:
    """Return an orthonormal basis of the directions that rows do not see, as columns, shape (n, r).

    SciPy has the same function, but takes longer to import than many problems take to solve.

    Args:
        rows: Shape (k, n).
        tolerance: Singular values up to this share of the largest count as zero.
    """
    _, values, axes = np.linalg.svd(rows)
    return np.asarray(axes[int((values > tolerance * values.max(initial=0.0)).sum()) :].T)


def independent_rows(rows: Array, tolerance: float) -> list[int]:
    """Return the indices of rows that span all of them; the next is always the one with most left without the others.

    Args:
        rows: Shape (k, n).
        tolerance: A row of which no more than this is left is no row of its own.
    """
    left, found = np.array(rows, dtype=float), list[int]()
    for _ in range(len(left)):
        sizes = np.linalg.norm(left, axis=1)
        k = int(sizes.argmax())
        if sizes[k] <= tolerance:
            break
        left -= np.outer(left @ left[k], left[k]) / sizes[k] ** 2
        left[k] = 0.0
        found.append(k)
    return sorted(found)
