"""Linear algebra as another processor may round it.

OpenBLAS has a kernel for each family of processors, and kernels round differently.  The result of each is the exact
solution for a matrix that differs in the last digits.  So a matrix whose last digits change before a factorization
stands for all kernels.  A test that passes on one processor by luck fails with such a matrix.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import scipy.linalg

# Units in the last place by which entries move.
_ULP = 2
_SYMMETRIC = ("cholesky", "eigh", "eigvalsh")
_NUMPY = (*_SYMMETRIC, "solve", "inv", "lstsq", "pinv", "qr", "svd")
_SCIPY = ("lu_factor", "null_space", "orth", "qr")


@contextmanager
def other_rounding(seed: int) -> Iterator[None]:
    """Round the matrices of NumPy's and SciPy's factorizations once more, in the same way for the same seed."""
    rng = np.random.default_rng(seed)

    def rounded(function: Callable[..., Any], symmetric: bool) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(matrix: Any, *others: Any, **options: Any) -> Any:
            values = np.asarray(matrix)
            if values.dtype != np.float64:
                return function(matrix, *others, **options)
            signs = rng.choice([-1.0, 0.0, 1.0], values.shape)
            if symmetric:
                signs = np.tril(signs) + np.swapaxes(np.tril(signs, -1), -1, -2)
            return function(values * (1 + _ULP * np.finfo(float).eps * signs), *others, **options)

        return call

    with mock.patch.multiple(np.linalg, **{n: rounded(getattr(np.linalg, n), n in _SYMMETRIC) for n in _NUMPY}):
        with mock.patch.multiple(scipy.linalg, **{n: rounded(getattr(scipy.linalg, n), False) for n in _SCIPY}):
            yield
