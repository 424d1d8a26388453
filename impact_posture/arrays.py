"""The type of the arrays of numbers in signatures, and a null space."""

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
