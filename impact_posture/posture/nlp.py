"""The nonlinear program, which is built once and solved for many starts, normals and targets.

NumPy, SciPy and CasADi (for MUMPS, within IPOPT) each bring a BLAS that uses all cores.  The systems here have about
a hundred unknowns, so these threads only wait for each other and block the cores of parallel starts.
:func:`one_blas_thread` stops that.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import casadi as ca
import numpy as np
import threadpoolctl

from impact_posture.arrays import Array
from impact_posture.dynamics.chart import Chart
from impact_posture.posture.compiled import CompileMode, compiled_solver
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.program import Program, parameters
from impact_posture.posture.program_rows import ProgramRows

IPOPT_OPTIONS: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.dual_inf_tol": 1e-7,
    "ipopt.compl_inf_tol": 1e-9,
    # Bounds are limits of the robot, which the solver must not relax.
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.honor_original_bounds": "yes",
    "ipopt.mu_strategy": "adaptive",
    # The rows of a program are of like size.  To scale and permute each matrix takes MUMPS longer than it saves.
    "ipopt.mumps_scaling": 0,
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.max_iter": 300,
    "print_time": False,
    "calc_lam_p": False,
    # Nothing uses sensitivities.
    "no_nlp_grad": True,
    "error_on_fail": False,
}
# The equations of the dual of a cone are quadratic, and violated equations let the bound ``t`` fall.  A step that
# violates them strongly to lower the objective never comes back.
_WORST_OPTIONS = {"ipopt.theta_max_fact": 1.0}
# Price of a meter of slack in units of the scale.  It has to exceed what a meter of freedom is worth, and 2 did not.
SLACK_PRICE = 50.0
CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True)
class SolveRecord:
    """Result of one run of the solver.

    Attributes:
        q: Final configuration, shape (nq,).
        status: Return status of IPOPT.
        iterations: Iterations of IPOPT.
        time_s: Wall time of the call.
        auxiliaries: Final auxiliaries of the constraints, shape (k,).
        minimized: Value that the solver minimized, in units of the scale.
    """

    q: Array
    status: str
    iterations: int
    time_s: float
    auxiliaries: Array
    minimized: float

    @property
    def converged(self) -> bool:
        """Whether IPOPT reports convergence.  The certificate is the proof."""
        return self.status in CONVERGED


@dataclass(frozen=True)
class PostureNLP:
    """A built program.

    Attributes:
        problem: The posture problem.
        program: Its expressions.
        solver: ``nlpsol`` of CasADi.
        build_time_s: Time to build and compile the program.
        compiled: Whether its functions run as machine code.
        compiler_fault: Reason why a compilation failed; empty else.
    """

    problem: PostureProblem
    program: Program
    solver: ca.Function
    build_time_s: float
    compiled: bool
    compiler_fault: str = ""

    @property
    def chart(self) -> Chart:
        """Coordinates of the robot."""
        return self.program.chart

    def at(self, problem: PostureProblem) -> PostureNLP:
        """Return the program with another target, whose expressions and bounds of rows are the same."""
        found = replace(self, problem=problem)
        vars(found)["_row_bounds"] = self._row_bounds
        return found

    def grown(self, problem: PostureProblem, *, compile: CompileMode = "auto") -> PostureNLP:
        """Build the program of a problem that this one grew into."""
        return build_nlp(problem, compile=compile, program=self.program)

    def solve(
        self, start: Array, *, scale: float | None = None, attempt: int = 0, price: float = SLACK_PRICE
    ) -> SolveRecord:
        """Solve from ``start``.

        Args:
            start: Configuration, shape (nq,).
            scale: Divisor of the objective; by default its value at ``start``.
            attempt: Index of the guess of the objective.
            price: Price of a meter of slack.
        """
        problem, nx = self.problem, self.chart.nx
        given = self.chart.to_x(start)
        x = np.clip(given, problem.lower, problem.upper)
        # The quantities at a posture within its limits are known as a rule.
        q = start if np.array_equal(x, given) else self.chart.to_q(x)
        scale = scale or problem.objective.value(q)
        guess = problem.objective.guess(q, scale, attempt)
        own = problem.guess(self.program.numeric.at(q))
        lower = np.concatenate([problem.lower, guess.lower, own.lower])
        upper = np.concatenate([problem.upper, guess.above, own.above])
        p = parameters(problem, self.chart, scale, price)
        x0 = np.concatenate([x, guess.values, own.values])
        began = time.perf_counter()
        answer = run_solver(self.solver, x0=x0, lbx=lower, ubx=upper, p=p, **self._row_bounds)
        stats = self.solver.stats()
        elapsed = time.perf_counter() - began
        found = np.array(answer["x"].nonzeros())
        return SolveRecord(
            q=self.chart.to_q(found[:nx]),
            status=str(stats["return_status"]),
            iterations=int(stats["iter_count"]),
            time_s=elapsed,
            auxiliaries=found[nx + guess.values.size :],
            minimized=float(answer["f"]),
        )

    @cached_property
    def _row_bounds(self) -> dict[str, Array]:
        norms = np.zeros(len(self.chart.quaternion_slices()))
        lower, upper = (np.concatenate([norms, bounds]) for bounds in self.problem.row_bounds)
        # The other rows belong to the objective: first equations, then inequalities that bound it from below.
        lifted = np.zeros(self.solver.size1_in("lbg") - len(lower))
        below = lifted.copy()
        below[lifted.size - self.program.bounded :] = -np.inf
        return {"lbg": np.concatenate([lower, below]), "ubg": np.concatenate([upper, lifted])}


class _CasadiOpenBLAS(threadpoolctl.OpenBLASController):  # type: ignore[misc]
    """The OpenBLAS of the CasADi wheels, under its name there."""

    internal_api = "casadi_openblas"
    filename_prefixes = ("libcasadi-tp-openblas",)


threadpoolctl.register(_CasadiOpenBLAS)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit every BLAS of this process, and of processes forked within, to one thread."""
    with _libraries().limit(limits=1):
        yield


@cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    ca.has_nlpsol("ipopt")  # This loads IPOPT and its BLAS, because the controller finds loaded libraries only.
    return threadpoolctl.ThreadpoolController()


def run_solver(solver: ca.Function, **arguments: Array) -> dict[str, ca.DM]:
    """Call an ``nlpsol``, and raise the Ctrl-C that IPOPT may catch."""
    with _noticing_interrupts():
        answer: dict[str, ca.DM] = solver(**arguments)
    return answer


@contextmanager
def _noticing_interrupts() -> Iterator[None]:
    """Raise a Ctrl-C after the solver, because the solver may take it for a failed evaluation and go on."""
    in_charge = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if not in_charge:
        yield
        return
    seen: list[int] = []

    def note(number: int, frame: object) -> None:
        seen.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if seen:
        raise KeyboardInterrupt


def build_nlp(
    problem: PostureProblem,
    *,
    compile: CompileMode = "auto",
    starts: int = 1,
    program: Program | None = None,
    rows: ProgramRows | None = None,
) -> PostureNLP:
    """Build the program; the number of ``starts`` decides whether compiling pays.

    Args:
        problem: The posture problem.
        compile: Whether to compile.
        starts: Number of runs.
        program: The expressions of a problem that grew into this one.
        rows: The rows of the constraints of such a problem, if another program has them.

    Raises:
        CompilerError, OutputError: As :func:`impact_posture.posture.compiled.compiled_solver`.
    """
    began = time.perf_counter()
    program = program or Program(problem, rows)
    symbols, derivatives = program.symbols(problem)
    options = IPOPT_OPTIONS | (_WORST_OPTIONS if problem.objective.attempts > 1 else {})
    # A program that grows is soon another one, so it is not worth compiling.
    built = compiled_solver(problem, symbols, options, compile, 1 if problem.grows else starts, derivatives)
    took = time.perf_counter() - began
    return PostureNLP(problem, program, built.solver, took, built.compiled, built.fault)
