"""Linear algebra as another processor may round it.

OpenBLAS has a kernel for each family of processors; they sum in other orders and with other instructions.  What any
of them returns is the exact answer to a matrix that differs in the last digits, so a matrix that is changed in its
last digits before a factorization stands for all of them.  A test that holds here by luck fails with such a matrix.
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
    """Within, the factorizations of NumPy and SciPy get matrices that are rounded once more; the same for a seed."""
    rng = np.random.default_rng(seed)

    def rounded(function: Callable[..., Any], symmetric: bool) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(matrix: Any, *others: Any, **options: Any) -> Any:
            given = np.asarray(matrix)
            if given.dtype != np.float64:
                return function(matrix, *others, **options)
            signs = rng.choice([-1.0, 0.0, 1.0], given.shape)
            if symmetric:
                signs = np.tril(signs) + np.swapaxes(np.tril(signs, -1), -1, -2)
            return function(given * (1 + _ULP * np.finfo(float).eps * signs), *others, **options)

        return call

    with mock.patch.multiple(np.linalg, **{n: rounded(getattr(np.linalg, n), n in _SYMMETRIC) for n in _NUMPY}):
        with mock.patch.multiple(scipy.linalg, **{n: rounded(getattr(scipy.linalg, n), False) for n in _SCIPY}):
            yield
