"""Linear algebra with the rounding errors of another processor.

OpenBLAS has a kernel for each family of processors, and each kernel rounds differently.  Each result is the exact
solution for a matrix that differs in the last digits.  Therefore, random changes in the last digits of a matrix
before its factorization represent all kernels.  A test that depends on the rounding of this processor fails after
such a change.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import scipy.linalg

# Size of the random change of an entry, in units in the last place.
_ULP = 2
_SYMMETRIC = ("cholesky", "eigh", "eigvalsh")
_NUMPY = (*_SYMMETRIC, "solve", "inv", "lstsq", "pinv", "qr", "svd")
_SCIPY = ("lu_factor", "null_space", "orth", "qr")


@contextmanager
def other_rounding(seed: int) -> Iterator[None]:
    """Change the last digits of all matrices that NumPy and SciPy factorize; the seed determines the changes."""
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
