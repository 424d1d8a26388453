"""Multi-start search: many feasible starts, one program, distinct optima, and the best certified posture."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ContactError, Infeasible, MetricError, SolverFailed
from impact_posture.posture.caveats import notes_on_impacts
from impact_posture.posture.certificate import Certificate, certify
from impact_posture.posture.compiled import CompileMode
from impact_posture.posture.elastic import elastic
from impact_posture.posture.nlp import PostureNLP, SolveRecord, build_nlp, one_blas_thread
from impact_posture.posture.posture_distance import distance
from impact_posture.posture.problem import PostureProblem, equality_jacobian, rank
from impact_posture.posture.starts import Projector, feasible_start
from impact_posture.processes import fork_map

Progress = Callable[[int, int], None]

# Optima closer than this in posture (tangent norm) and in objective (relative) are the same optimum.
SAME_POSTURE, _SAME_OBJECTIVE = 1e-2, 1e-4
# From this number of starts on, a single hit of the best optimum gets a note.
_MANY = 8


@dataclass(frozen=True)
class Optimum:
    """A distinct local optimum.

    Attributes:
        q: Posture, shape (nq,).
        objective: Value of the objective.
        hits: Number of starts that ended there.
    """

    q: Array
    objective: float
    hits: int


@dataclass(frozen=True)
class PostureSolution:
    """The solution of a posture problem.

    Attributes:
        problem: The posture problem.
        initial: The given posture, moved to the constraints if it did not satisfy them.
        moved: Length of that move, tangent norm.
        q: The best certified posture.
        certificate: Certificate of ``q``.
        redundancy: Degrees of freedom that the equalities leave at ``q``.
        optima: Distinct optima, best first.
        starts: Number of starts.
        feasible_starts: Starts that reached the constraints.
        certified_starts: Starts that ended at a certified posture.
        status: Return status of IPOPT for the best run.
        iterations: Iterations of the best run.
        solve_time_s: Wall time of all runs together.
        build_time_s: Time to build the program.
        compiled: Whether it ran as machine code.
        notes: Notes for the user about the solution.
        compiler_fault: Reason why a compilation failed; empty else.
    """

    problem: PostureProblem
    initial: Array
    moved: float
    q: Array
    certificate: Certificate
    redundancy: int
    optima: tuple[Optimum, ...]
    starts: int
    feasible_starts: int
    certified_starts: int
    status: str
    iterations: int
    solve_time_s: float
    build_time_s: float
    compiled: bool
    notes: tuple[str, ...]
    compiler_fault: str = ""

    @property
    def reduction(self) -> float:
        """``1 − objective(q)/objective(initial)``."""
        objective = self.problem.objective
        return 1 - objective.value(self.q) / objective.value(self.initial)


@dataclass(frozen=True)
class _Run:
    start: Array | None
    record: SolveRecord | None
    objective: float
    minimized: float
    certificate: Certificate | None


@one_blas_thread()
def solve(
    problem: PostureProblem,
    *,
    starts: int = 16,
    seed: int = 0,
    jobs: int = 2,
    compile: CompileMode = "auto",
    progress: Progress | None = None,
    guesses: Sequence[Array] = (),
) -> PostureSolution:
    """Solve from the given posture, from feasible ``guesses`` and from random feasible ones: ``starts`` in all.

    Raises:
        Infeasible: No posture satisfies the constraints; the error names the conflicting constraints.
        SolverFailed: No run ended at a certified posture.
    """
    initial = _initial(problem, seed)
    began = time.perf_counter()
    nlp = build_nlp(problem, compile=compile, starts=starts)
    scale = _initial_objective(problem, initial)
    job = _Job(nlp, (initial, *guesses), scale, seed)
    runs = _run_all(job, starts, jobs, progress)
    good = [r for r in runs if r.certificate is not None and r.certificate.holds()]
    if not good:
        raise _failure(runs)
    # Of equally good runs the first counts, so that the solution does not depend on the speed of processes.
    best = min(good, key=lambda r: round(r.minimized, 9))
    assert best.record is not None and best.certificate is not None  # noqa: S101 (narrows types)
    q, certificate, notes = best.record.q, best.certificate, []
    numeric = Numeric(problem.robot.model)
    redundancy = problem.robot.nv - rank(equality_jacobian(problem, numeric.at(q)))
    if redundancy == 0 and best.objective > scale * (1 - 1e-6):
        notes.append("no redundancy left: the constraints alone determine the posture, there is nothing to optimize")
    elif redundancy == 0:
        notes.append("no redundancy left: this is the best of separate postures that the constraints allow")
    elif best.objective > scale * (1 - 1e-6):
        notes.append("no better posture found: the initial one is already (locally) optimal for this impact")
    optima = distinct(problem, [(r.record.q, r.objective) for r in good if r.record is not None])
    notes += notes_on_impacts(problem.objective, initial, q)
    hits = sum(o.hits for o in optima)
    if len(optima) > 1 and optima[0].hits == 1 and hits >= _MANY:
        notes.append(
            f"the best of {len(optima)} optima was found once in {hits} starts: more `starts` may find a better one"
        )
    return PostureSolution(
        problem=problem,
        initial=initial,
        moved=float(np.linalg.norm(pin.difference(problem.robot.model, problem.given, initial))),
        q=q,
        certificate=certificate,
        redundancy=redundancy,
        optima=optima,
        starts=starts,
        feasible_starts=sum(r.start is not None for r in runs),
        certified_starts=len(good),
        status=best.record.status,
        iterations=best.record.iterations,
        solve_time_s=time.perf_counter() - began - nlp.build_time_s,
        build_time_s=nlp.build_time_s,
        compiled=nlp.compiled,
        notes=(*problem.notes, *notes),
        compiler_fault=nlp.compiler_fault,
    )


def _initial(problem: PostureProblem, seed: int) -> Array:
    """The given posture pulled onto the constraints, or the first other start that reaches them."""
    for index in range(5):
        start = feasible_start(problem, index, seed)
        if start is not None:
            return start
    answer = elastic(problem, seed)
    if answer.conflicts:
        limits = f"; there {', '.join(answer.at_limits[:4])}" if answer.at_limits else ""
        raise Infeasible(
            answer.conflicts, hint=f"relax one of them, move the target, or start from another `posture`{limits}"
        )
    found = Projector(problem).project(answer.q)
    if found.violation > 1e-8:
        raise SolverFailed(
            f"a posture within {found.violation:.1e} of the constraints was found, but none on them",
            where="problem",
            hint="start from a `posture` nearer to the target",
        )
    return found.q


def _initial_objective(problem: PostureProblem, initial: Array) -> float:
    """The objective at the start, which scales the program and so must exist.

    Raises:
        ContactError: The contact point cannot move along the normal there.
    """
    objective = problem.objective
    # The value is rounding if nothing can move along the normal.
    value = objective.value(initial) if objective.movable(initial) else 0.0
    if not (np.isfinite(value) and value > 0):
        frames = ", ".join(f"'{contact.frame}'" for contact in objective.contacts)
        raise ContactError(
            f"the contact point at {frames} cannot move along the normal",
            where="normal",
            hint="choose another frame, normal or posture: an impact along it moves nothing",
        )
    return value


@one_blas_thread()
def run_start(nlp: PostureNLP, start: Array, scale: float) -> tuple[SolveRecord, Certificate]:
    """Solve from a feasible start and certify the end; try the other guesses of the objective if it fails."""
    record = nlp.solve(start, scale=scale)
    certificate = certify(nlp.problem, record.q, scale, record.auxiliaries)
    for attempt in range(1, nlp.problem.objective.attempts):
        if certificate.holds():
            break
        again = nlp.solve(start, scale=scale, attempt=attempt)
        certificate = certify(nlp.problem, again.q, scale, again.auxiliaries)
        record = replace(
            again,
            iterations=record.iterations + again.iterations,
            time_s=record.time_s + again.time_s,
            cpu_s=record.cpu_s + again.cpu_s,
        )
    return record, certificate


@dataclass(frozen=True, eq=False)
class _Job:
    """Data of all starts: the program, the first starts, the scale, and the seed of the other starts."""

    nlp: PostureNLP
    known: tuple[Array, ...]
    scale: float
    seed: int


def _run(job: _Job, index: int) -> _Run:
    nlp, scale = job.nlp, job.scale
    start = job.known[index] if index < len(job.known) else feasible_start(nlp.problem, index, job.seed)
    if start is None:
        return _Run(None, None, np.inf, np.inf, None)
    try:
        record, certificate = run_start(nlp, start, scale)
        objective = nlp.problem.objective.value(record.q)
    except MetricError:
        # This start led to a posture where the objective does not exist.  The other starts go on.
        return _Run(start, None, np.inf, np.inf, None)
    problem = nlp.problem
    minimized = objective / scale
    if problem.requirements.regularization:
        minimized += problem.requirements.regularization * distance(nlp.chart, record.q, problem.given) ** 2
    return _Run(start, record, objective, minimized, certificate)


def _run_all(job: _Job, starts: int, jobs: int, progress: Progress | None) -> list[_Run]:
    runs: dict[int, _Run] = {}
    # A fork takes longer than three starts.
    with fork_map(partial(_run, job), starts, jobs if starts > 3 else 1) as results:
        for index, run in results:
            runs[index] = run
            if progress:
                progress(len(runs), starts)
    return [runs[index] for index in range(starts)]


def distinct(problem: PostureProblem, ends: list[tuple[Array, float]]) -> tuple[Optimum, ...]:
    """Group ends at the same posture, best objective first."""
    found: list[Optimum] = []
    for q, objective in sorted(ends, key=lambda end: end[1]):
        for k, known in enumerate(found):
            near = abs(objective - known.objective) <= _SAME_OBJECTIVE * max(abs(known.objective), 1e-300)
            if near and np.linalg.norm(wrapped_difference(problem, known.q, q)) < SAME_POSTURE:
                found[k] = Optimum(known.q, known.objective, known.hits + 1)
                break
        else:
            found.append(Optimum(q, objective, 1))
    return tuple(found)


def wrapped_difference(problem: PostureProblem, one: Array, other: Array) -> Array:
    """Return ``other ⊖ one`` without full turns of revolute joints."""
    step = np.array(pin.difference(problem.robot.model, one, other))
    for slot in Chart(problem.robot.model).slots:
        if slot.kind.family == "revolute":
            step[slot.v] = (step[slot.v] + np.pi) % (2 * np.pi) - np.pi
    return step


def _failure(runs: list[_Run]) -> SolverFailed:
    solved = [r for r in runs if r.record is not None and r.certificate is not None]
    words = sorted({r.record.status for r in solved if r.record is not None})
    if not solved:
        return SolverFailed(
            "the objective does not exist where the starts ended", where="solver", hint="choose another `objective`"
        )
    nearest = min((r.certificate for r in solved if r.certificate), key=lambda c: c.stationarity)
    return SolverFailed(
        f"none of {len(solved)} feasible starts ended at a certified posture (solver: {', '.join(words)}; best "
        f"stationarity {nearest.stationarity:.1e}, violation {nearest.primal:.1e})",
        where="solver",
        hint="try more `starts`, another `seed` or `posture`, or a small `regularization`",
    )
