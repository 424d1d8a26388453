"""One thread for linear algebra while postures are optimized.

NumPy, SciPy and CasADi (for MUMPS, within IPOPT) each bring a BLAS that takes all cores.  The systems here have some
hundred unknowns: its threads only wait for each other, and take the cores from the starts that run beside.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import casadi as ca
import threadpoolctl


class _CasadiOpenBLAS(threadpoolctl.OpenBLASController):  # type: ignore[misc]
    """The one in CasADi's wheels, under the name that it has there."""

    internal_api = "casadi_openblas"
    filename_prefixes = ("libcasadi-tp-openblas",)


threadpoolctl.register(_CasadiOpenBLAS)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit every BLAS of this process to one thread within; processes forked within keep to it."""
    with _libraries().limit(limits=1):
        yield


@cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    ca.has_nlpsol("ipopt")  # loads it: what it is linked with is looked for among what is loaded
    return threadpoolctl.ThreadpoolController()
