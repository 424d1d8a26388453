"""Call IPOPT with suitable options and with one thread for linear algebra, and let Ctrl-C stop the solver.

NumPy, SciPy and CasADi (for MUMPS in IPOPT) each bring a BLAS that uses all cores.  The linear systems have about a
hundred unknowns.  For systems this small, the threads of a BLAS only wait for each other and block the cores of
parallel starts, so :func:`one_blas_thread` limits each BLAS to one thread.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import casadi as ca
import threadpoolctl

from impact_posture.system.arrays import Array

IPOPT_OPTIONS: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.dual_inf_tol": 1e-7,
    "ipopt.compl_inf_tol": 1e-9,
    # The bounds are limits of the robot, so the solver must not relax the bounds.
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.honor_original_bounds": "yes",
    "ipopt.mu_strategy": "adaptive",
    # All rows have similar sizes, so scaling and permuting each matrix would take MUMPS more time than it would save.
    "ipopt.mumps_scaling": 0,
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.max_iter": 300,
    "print_time": False,
    # IPOPT rejects a step at which functions overflow, so warnings of CasADi about the overflow are hidden.
    "show_eval_warnings": False,
    "calc_lam_p": False,
    # Do not compute sensitivities of the solution, because they are not used.
    "no_nlp_grad": True,
    "error_on_fail": False,
}
# Options for objectives that are a maximum.  The worst case over a cone of normals has quadratic equations, and the
# objective can decrease while these equations are violated.  After a step with a large violation, IPOPT may not
# recover.
WORST_OPTIONS = {"ipopt.theta_max_fact": 1.0}
CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
# With these options, IPOPT starts from the given unknowns even if they lie on bounds.  By default, IPOPT moves
# unknowns away from bounds and needs iterations to move them back.
WARM_OPTIONS = {"ipopt.warm_start_init_point": "yes"} | {
    f"ipopt.warm_start_{name}": 1e-8
    for name in ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")
}


class _CasadiOpenBLAS(threadpoolctl.OpenBLASController):  # type: ignore[misc]
    """Thread controller for the OpenBLAS in the CasADi wheels, whose file name threadpoolctl does not know."""

    internal_api = "casadi_openblas"
    filename_prefixes = ("libcasadi-tp-openblas",)


threadpoolctl.register(_CasadiOpenBLAS)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit every BLAS to one thread, in this process and in processes forked within the context."""
    with _libraries().limit(limits=1):
        yield


@cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    ca.has_nlpsol("ipopt")  # Load the BLAS of IPOPT, which is visible only then.
    return threadpoolctl.ThreadpoolController()


def run_solver(solver: ca.Function, **arguments: Array) -> dict[str, ca.DM]:
    """Call an ``nlpsol``; after a Ctrl-C, raise ``KeyboardInterrupt`` when the call returns.

    IPOPT may treat a Ctrl-C as a failed evaluation and ignore it.
    """
    seen: list[int] = []

    def note(number: int, frame: object) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    default = signal.default_int_handler
    in_charge = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is default
    if in_charge:
        signal.signal(signal.SIGINT, note)
    try:
        answer: dict[str, ca.DM] = solver(**arguments)
    finally:
        if in_charge:
            signal.signal(signal.SIGINT, default)
    if seen:
        raise KeyboardInterrupt
    return answer
