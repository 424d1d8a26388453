"""The nonlinear program: built once, solved for many starts, normals and targets.

Formulation (the "lifted" one): the impact's linear solve is left to IPOPT::

    min over x, a, f, s   aᵀWa        (or λ/2)
    subject to            M(q)a − J_sᵀf − Jᵀs = 0,  J_s a + εf = 0,  what ties s to n,
                          c(q) within bounds,  |quaternions| = 1,  limits,

so that every function is linear or quadratic in the auxiliaries and the exact Hessian stays small
(``tests/benchmarks/formulations.py`` measures both forms).  An inner maximum adds its own form
(:mod:`impact_posture.impact.worst_case`).
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.compiled import CompileMode, compiled_solver
from impact_posture.posture.posture_distance import distance_squared
from impact_posture.posture.problem import PostureProblem

Vector = NDArray[np.float64]

IPOPT_OPTIONS: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.dual_inf_tol": 1e-7,
    "ipopt.compl_inf_tol": 1e-9,
    # Bounds are the robot's limits: they are not for the solver to relax.
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.honor_original_bounds": "yes",
    "ipopt.mu_strategy": "adaptive",
    "ipopt.max_iter": 300,
    "print_time": False,
    "calc_lam_p": False,
    # Nobody asks for sensitivities.
    "no_nlp_grad": True,
    "error_on_fail": False,
}
# The equations of a cone's dual are quadratic, and a bound ``t`` falls as far as equations are broken for it: steps
# that break them badly to gain in the objective never come back.
_WORST_OPTIONS = {"ipopt.theta_max_fact": 1.0}
CONVERGED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True)
class SolveRecord:
    """What one run of the solver gave.

    Attributes:
        q: Configuration at its end, shape (nq,).
        status: IPOPT's word.
        iterations: Its iterations.
        time_s: Wall time of the call.
        cpu_s: Processor time of the call, all threads together.
    """

    q: Vector
    status: str
    iterations: int
    time_s: float
    cpu_s: float

    @property
    def converged(self) -> bool:
        """Whether IPOPT says that it converged; no proof (see the certificate)."""
        return self.status in CONVERGED


@dataclass(frozen=True)
class PostureNLP:
    """A built program.

    Attributes:
        problem: What it stands for.
        chart: Coordinates.
        solver: CasADi's ``nlpsol``.
        size: Numbers of unknowns, of which the first ``chart.nx`` are ``x``.
        bounded: How many of its rows, the last ones, are inequalities ``≤ 0`` of the objective.
        build_time_s: Time to build (and compile) it.
        compiled: Whether its functions run as machine code.
        compiler_fault: Why they do not although they should; empty else.
    """

    problem: PostureProblem
    chart: Chart
    solver: ca.Function
    size: int
    bounded: int
    build_time_s: float
    compiled: bool
    compiler_fault: str = ""

    def solve(self, start: Vector, *, scale: float | None = None, attempt: int = 0) -> SolveRecord:
        """Solve from ``start``; the objective is divided by ``scale``, its value there unless given.

        ``attempt``: which of the objective's guesses to begin with.
        """
        problem, nx = self.problem, self.chart.nx
        x = np.clip(self.chart.to_x(start), problem.lower, problem.upper)
        scale = scale or problem.objective.value(self.chart.to_q(x))
        guess = problem.objective.guess(self.chart.to_q(x), scale, attempt)
        lower, upper = np.concatenate([problem.lower, guess.lower]), np.full(self.size, np.inf)
        upper[:nx] = problem.upper
        began, busy = time.perf_counter(), time.process_time()
        p = parameters(problem, self.chart, scale)
        x0 = np.concatenate([x, guess.values])
        answer = run_solver(self.solver, x0=x0, lbx=lower, ubx=upper, p=p, **_row_bounds(problem, self))
        elapsed, busy = time.perf_counter() - began, time.process_time() - busy
        stats = self.solver.stats()
        q = self.chart.to_q(np.array(answer["x"]).reshape(-1)[:nx])
        return SolveRecord(q, str(stats["return_status"]), int(stats["iter_count"]), elapsed, busy)


def run_solver(solver: ca.Function, **arguments: Vector) -> dict[str, ca.DM]:
    """Call an ``nlpsol``; a Ctrl-C that IPOPT caught goes on as one."""
    with _noticing_interrupts():
        answer: dict[str, ca.DM] = solver(**arguments)
    return answer


@contextmanager
def _noticing_interrupts() -> Iterator[None]:
    """Raise a Ctrl-C after the solver where the solver took it for a failed evaluation and went on."""
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


def build_nlp(problem: PostureProblem, *, compile: CompileMode = "auto", starts: int = 1) -> PostureNLP:
    """Build the program; ``starts`` tells how often it will be solved, so that compiling is worth it or not."""
    began = time.perf_counter()
    chart = Chart(problem.robot.model)
    symbols, bounded = program(problem, chart)
    options = IPOPT_OPTIONS | (_WORST_OPTIONS if problem.objective.attempts > 1 else {})
    built = compiled_solver(problem, symbols, options, compile, starts)
    size = int(symbols["x"].numel())
    took = time.perf_counter() - began
    return PostureNLP(problem, chart, built.solver, size, bounded, took, built.compiled, built.fault)


def program(problem: PostureProblem, chart: Chart) -> tuple[dict[str, ca.SX], int]:
    """Its expressions ``x`` (unknowns), ``p`` (parameters), ``f`` and ``g``, and how many last rows are ``≤ 0``."""
    x = ca.SX.sym("x", chart.nx)
    own = ca.SX.sym("own", len(problem.objective.parameters))
    scale, weight = ca.SX.sym("scale"), ca.SX.sym("weight")
    reference = ca.SX.sym("reference", chart.nx)
    tree = Tree(problem.robot.model, chart.configuration(x), x)
    lifted = problem.objective.lift(tree, own, scale)
    rows, targets = [chart.norms(x)], []
    for index, constraint in enumerate(problem.constraints):
        p = ca.SX.sym(f"p{index}", len(constraint.parameters))
        targets.append(p)
        rows.append(constraint.symbolic(tree, p)[problem.carried(index)])
    rows += [lifted.residual, lifted.inequalities]
    value = lifted.value / scale + weight * distance_squared(chart, tree.q, chart.configuration(reference))
    symbols = {
        "x": ca.vertcat(x, lifted.variables),
        "p": ca.vertcat(own, scale, weight, reference, *targets),
        "f": value,
        "g": ca.vertcat(*rows),
    }
    return symbols, int(lifted.inequalities.numel())


def parameters(problem: PostureProblem, chart: Chart, scale: float) -> Vector:
    """Values of the program's parameters."""
    return np.concatenate(
        [
            problem.objective.parameters,
            [scale, problem.requirements.regularization],
            chart.to_x(problem.given),
            *[c.parameters for c in problem.constraints],
        ]
    )


def _row_bounds(problem: PostureProblem, nlp: PostureNLP) -> dict[str, Vector]:
    norms = np.zeros(len(nlp.chart.quaternion_slices()))
    rows = list(enumerate(problem.constraints))
    lower = np.concatenate([norms, *[c.lower[problem.carried(i)] for i, c in rows]])
    upper = np.concatenate([norms, *[c.upper[problem.carried(i)] for i, c in rows]])
    # The rest are the objective's: equations, then what bounds it from below.
    lifted = np.zeros(nlp.solver.size1_in("lbg") - len(lower))
    below = lifted.copy()
    below[lifted.size - nlp.bounded :] = -np.inf
    return {"lbg": np.concatenate([lower, below]), "ubg": np.concatenate([upper, lifted])}
