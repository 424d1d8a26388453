"""The nonlinear program, which is built once and solved from many starts and for many normals and targets."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from typing import Any

import casadi as ca
import numpy as np

from impact_posture.dynamics.chart import Chart
from impact_posture.posture.program.compiled_solver import CompileMode, compiled_solver
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.ipopt import CONVERGED, IPOPT_OPTIONS, WARM_OPTIONS, WORST_OPTIONS, run_solver
from impact_posture.posture.program.program import Program, parameters
from impact_posture.posture.program.program_rows import ProgramRows
from impact_posture.system.arrays import Array

# Penalty per meter of :attr:`LiftedRows.slack`, in units of the initial objective.  The penalty must exceed the
# decrease of the objective per meter of slack.  With a penalty of 2, solutions had slack.
SLACK_PRICE = 50.0
# Counter for the identifiers of the programs in this process.
_NUMBERS = count()


@dataclass(frozen=True, eq=False)
class WarmStart:
    """Final values of a solver run, from which a run of the same program with another target can continue.

    Attributes:
        x: All unknowns, shape (n,), between ``lower`` and ``upper``.
        of_bounds: Multipliers of the bounds ``lower`` and ``upper``, shape (n,).
        of_rows: Multipliers of the rows, shape (m,).
        scale: Divisor of the objective in this run; the multipliers are for the divided objective.
    """

    program: int
    x: Array
    lower: Array
    upper: Array
    of_bounds: Array
    of_rows: Array
    scale: float


@dataclass(frozen=True)
class SolveRecord:
    """Result of a solver run: posture, status and iterations of IPOPT, and wall time of the call.

    ``auxiliaries`` are the final values of the auxiliary unknowns of the constraints, shape (k,).  ``minimized`` is
    the final value of the function that the solver minimizes, divided by the scale.  ``end`` contains all values that
    a warm start needs.
    """

    q: Array
    status: str
    iterations: int
    time_s: float
    auxiliaries: Array
    minimized: float
    end: WarmStart

    @property
    def converged(self) -> bool:
        """Whether IPOPT reports convergence; only the certificate proves that the posture is optimal."""
        return self.status in CONVERGED


@dataclass(frozen=True)
class PostureNLP:
    """A built program: its expressions, and the CasADi solver ``nlpsol``.

    Attributes:
        build_time_s: Time to build and compile the program.
        compiled: Whether the functions of the solver run as machine code.
        compiler_fault: Reason why a compilation failed; empty if no compilation failed.
        number: Identifier of the program; a program for another target keeps this identifier.
    """

    problem: ConstrainedProblem
    program: Program
    solver: ca.Function
    build_time_s: float
    compiled: bool
    compiler_fault: str = ""
    number: int = field(default_factory=_NUMBERS.__next__)

    @property
    def chart(self) -> Chart:
        """Chart coordinates of the robot."""
        return self.program.chart

    def at(self, problem: ConstrainedProblem) -> PostureNLP:
        """Return the program for a problem with another target but the same expressions and row bounds."""
        nlp = self.bounded(problem)
        vars(nlp)["_row_bounds"] = self._row_bounds
        return nlp

    def bounded(self, problem: ConstrainedProblem) -> PostureNLP:
        """Return the program for a problem with other row bounds."""
        nlp = replace(self, problem=problem)
        vars(nlp)["_warm_solver"] = self._warm_solver
        return nlp

    def grown(self, problem: ConstrainedProblem, *, compile: CompileMode = "auto") -> PostureNLP:
        """Build the program of ``problem``, which is :attr:`problem` with additional rows."""
        return build_nlp(problem, compile=compile, program=self.program)

    def solve(
        self,
        start: Array,
        *,
        scale: float | None = None,
        attempt: int = 0,
        price: float = SLACK_PRICE,
        warm: WarmStart | None = None,
    ) -> SolveRecord:
        """Solve from the configuration ``start``, shape (nq,).

        ``scale`` divides the objective, by default its value at ``start``.  ``attempt`` is the index of the initial
        guess for the unknowns that the objective adds.  ``price`` is the penalty per meter of slack.  ``warm`` has
        the final values of a run that ended at ``start`` with another target; values of another program are ignored.
        """
        scale = scale or self.problem.objective.value(start)
        if warm is None or warm.program != self.number:
            return self._run(self.solver, self._cold(start, scale, attempt), price)
        ratio = warm.scale / scale
        warm = replace(warm, scale=scale, of_bounds=ratio * warm.of_bounds, of_rows=ratio * warm.of_rows)
        record = self._run(self._warm_solver, warm, price)
        if record.converged:
            return record
        again = self._run(self.solver, self._cold(start, scale, attempt), price)
        return replace(again, iterations=record.iterations + again.iterations, time_s=record.time_s + again.time_s)

    def _cold(self, start: Array, scale: float, attempt: int) -> WarmStart:
        """Return initial values of all unknowns, without multipliers."""
        problem, unclipped = self.problem, self.chart.to_x(start)
        x = np.clip(unclipped, problem.lower, problem.upper)
        # Use ``start`` itself if possible, because the impact quantities at ``start`` are usually cached.
        q = start if np.array_equal(x, unclipped) else self.chart.to_q(x)
        impact, rows = problem.objective.guess(q, scale, attempt), problem.guess(self.program.numeric.at(q))
        return WarmStart(
            program=self.number,
            x=np.concatenate([x, impact.values, rows.values]),
            lower=np.concatenate([problem.lower, impact.lower, rows.lower]),
            upper=np.concatenate([problem.upper, impact.above, rows.above]),
            of_bounds=np.zeros(0),
            of_rows=np.zeros(0),
            scale=scale,
        )

    def _run(self, solver: ca.Function, start: WarmStart, price: float) -> SolveRecord:
        p = parameters(self.problem, self.chart, start.scale, price)
        multipliers = {"lam_x0": start.of_bounds, "lam_g0": start.of_rows} if start.of_rows.size else {}
        began = time.perf_counter()
        answer = run_solver(
            solver, x0=start.x, lbx=start.lower, ubx=start.upper, p=p, **self._row_bounds, **multipliers
        )
        stats = solver.stats()
        elapsed = time.perf_counter() - began
        x, of_bounds, of_rows = (np.array(answer[key].nonzeros()) for key in ("x", "lam_x", "lam_g"))
        return SolveRecord(
            q=self.chart.to_q(x[: self.chart.nx]),
            status=str(stats["return_status"]),
            iterations=int(stats["iter_count"]),
            time_s=elapsed,
            auxiliaries=x[x.size - sum(c.unknowns for c in self.problem.constraints) :],
            minimized=float(answer["f"]),
            end=replace(start, x=x, of_bounds=of_bounds, of_rows=of_rows),
        )

    @cached_property
    def _warm_solver(self) -> ca.Function:
        names = {"grad_f": "nlp_grad_f", "jac_g": "nlp_jac_g", "hess_lag": "nlp_hess_l"}
        known = {option: self.solver.get_function(name) for option, name in names.items()}
        options = _options(self.problem) | WARM_OPTIONS | known
        return ca.nlpsol("warm", "ipopt", self.solver.oracle(), options)

    @cached_property
    def _row_bounds(self) -> dict[str, Array]:
        norms = np.zeros(len(self.chart.quaternion_slices()))
        lower, upper = (np.concatenate([norms, bounds]) for bounds in self.problem.row_bounds)
        # The remaining rows belong to the objective: first equations, then inequalities.
        zeros = np.zeros(self.solver.size1_in("lbg") - len(lower))
        below = np.where(np.arange(zeros.size) < zeros.size - self.program.bounded, 0.0, -np.inf)
        return {"lbg": np.concatenate([lower, below]), "ubg": np.concatenate([upper, zeros])}


def build_nlp(
    problem: ConstrainedProblem,
    *,
    compile: CompileMode = "auto",
    starts: int = 1,
    program: Program | None = None,
    rows: ProgramRows | None = None,
) -> PostureNLP:
    """Build the program for ``starts`` runs; their number decides whether compiling saves time.

    ``program`` is a program of the same problem with fewer rows; its expressions are reused.  ``rows`` are the rows
    of the constraints, if they are already built.

    Raises:
        CompilerError, OutputError: For the same reasons as in
            :func:`impact_posture.posture.program.compiled_solver.compiled_solver`.
    """
    began = time.perf_counter()
    program = program or Program(problem, rows)
    symbols, derivatives = program.symbols(problem)
    # A program that can grow is soon replaced, so it is compiled only if this saves time for a single run.
    built = compiled_solver(problem, symbols, _options(problem), compile, 1 if problem.grows else starts, derivatives)
    took = time.perf_counter() - began
    return PostureNLP(problem, program, built.solver, took, built.compiled, built.fault)


def _options(problem: ConstrainedProblem) -> dict[str, Any]:
    return IPOPT_OPTIONS | (WORST_OPTIONS if problem.objective.attempts > 1 else {})
