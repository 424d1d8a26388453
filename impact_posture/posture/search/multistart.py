"""Multi-start search: solve one program from many feasible starts, and return the best certified posture."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.config.json_block import JsonBlock
from impact_posture.config.problem_settings import JOBS, STARTS
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import SolverFailed
from impact_posture.posture.manifold.feasible_start import FEASIBLE
from impact_posture.posture.program.certificate import Certificate
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian, rank
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.posture.search.growing_search import GrowingSearch, Progress, SolverRun
from impact_posture.posture.search.impact_notes import notes_on_impacts
from impact_posture.posture.search.initial_posture import initial_objective, initial_posture
from impact_posture.posture.search.screening import Screening, screen, screenable
from impact_posture.posture.search.singular_target import singular_target
from impact_posture.posture.search.start_draws import StartDraws
from impact_posture.posture.search.unseen_optima import SearchEstimate, hits_by_value
from impact_posture.system.arrays import Array

# Two final postures can be the same optimum only if their tangent distance is below this value.
SAME_POSTURE = 1e-2
# Two final postures can be the same optimum only if the relative difference of their objectives is below this
# value.
_SAME_OBJECTIVE = 1e-4
# Objectives, divided by the initial objective, are compared with this number of decimals.
_DIGITS = 9
# If the relative reduction of the objective is below this value, the result is not reported as better.  The jump is
# the square root of the objective, so the jump then changes by less than 0.05 %.
_NO_GAIN = 1e-3
# If a search has at least this number of starts, and at most one start ended at the best optimum, a note is added.
_MANY = 8


@dataclass(frozen=True)
class Optimum(JsonBlock):
    """A distinct local optimum: posture, shape (nq,), objective, and number of starts that ended there."""

    q: Array
    objective: float
    hits: int


@dataclass(frozen=True)
class PostureSolution:
    """The solution of a posture problem.

    Attributes:
        initial: The given posture, projected onto the constraints if it violates them, shape (nq,).
        moved: Tangent distance from the given posture to ``initial``.
        q: The best certified posture, shape (nq,).
        redundancy: Number of degrees of freedom at ``q`` that remain under the equality constraints.
        optima: Distinct optima, best first.
        estimate: Estimate of what the search may have missed.
        feasible_starts: Number of starts that reached the constraints.
        certified_starts: Number of starts that ended at a certified posture where no original shapes touch.
        colliding_starts: Number of starts that ended at a certified posture where original shapes touch.
        dominated_starts: Number of starts that were stopped because they could not become the best.
        status: Return status of IPOPT for the best run.
        solve_time_s: Wall time of all runs together, s.
        start_time_s: Median over the starts of the wall time of all runs from a start, s.
        compiled: Whether the program ran as machine code.
        notes: Notes for the user about the solution.
        compiler_fault: Reason why a compilation failed; empty if no compilation failed.
    """

    problem: ConstrainedProblem
    initial: Array
    moved: float
    q: Array
    certificate: Certificate
    redundancy: int
    optima: tuple[Optimum, ...]
    estimate: SearchEstimate
    starts: int
    feasible_starts: int
    certified_starts: int
    colliding_starts: int
    dominated_starts: int
    status: str
    iterations: int
    solve_time_s: float
    start_time_s: float
    build_time_s: float
    compiled: bool
    notes: tuple[str, ...]
    compiler_fault: str = ""

    @property
    def reduction(self) -> float:
        """Relative reduction of the objective, ``1 − objective(q)/objective(initial)``."""
        objective = self.problem.objective
        return 1 - objective.value(self.q) / objective.value(self.initial)


@one_blas_thread()
def solve(
    problem: ConstrainedProblem,
    *,
    starts: int = STARTS,
    seed: int = 0,
    jobs: int = JOBS,
    compile: CompileMode = "auto",
    progress: Progress | None = None,
    guesses: Sequence[Array] = (),
    finish_all: bool = False,
    screened: int = 0,
) -> PostureSolution:
    """Solve from the given posture, from feasible ``guesses``, shape (nq,) each, and from random feasible postures.

    ``starts`` is the least number of starts, because the given posture and all guesses are always starts.  ``seed``
    is the seed of the random postures.  ``progress`` is called with the numbers of finished starts and of all starts.
    ``finish_all`` also finishes starts that can no longer become the best.  If ``screened`` is not 0, the search
    screens at most ``screened`` random postures (:mod:`impact_posture.posture.search.screening`).  The best screened
    postures then replace the random postures as starts.

    Raises:
        Infeasible: No posture satisfies the constraints; the error names the conflicting constraints.
        SolverFailed: No run ended at a certified posture.
    """
    problem, initial, rows = initial_posture(problem, seed)
    scale = initial_objective(problem, initial)
    began = time.perf_counter()
    known, hits, screening = (initial, *guesses), [1] * (1 + len(guesses)), None
    if screened and screenable(problem):
        screening = screen(problem, initial, screened, seed)
        known, hits = (*known, *screening.guesses), [*hits, *screening.hits]
        starts = len(known)
    starts = max(starts, len(known))
    hits += [1] * (starts - len(hits))
    draws = StartDraws(problem, known, starts, seed)
    search = GrowingSearch(problem, draws, scale, compile=compile, finish_all=finish_all, rows=rows)
    runs = search.run(jobs, progress)
    problem, nlp = search.problem, search.nlp
    certified = [r for r in runs if r.good]
    if not certified:
        raise _failure(problem, runs)
    good, touching = _without_collisions(problem, certified)
    if not good:
        fault = f"original shapes touch at all {len(certified)} certified postures: {touching}"
        design = problem.surroundings.by_design if problem.surroundings else ""
        hint = f"try more `starts`, another `posture`, or a larger `clearance`; {design}"
        raise SolverFailed(fault, where="solver", hint=hint)
    # Among equally good runs, take the first in the order of starts, so that the solution does not depend on timing.
    best = min(good, key=lambda r: round(r.minimized, _DIGITS))
    assert best.record is not None and best.certificate is not None  # noqa: S101 (narrows types)
    q, certificate, notes = best.record.q, best.certificate, []
    numeric = Numeric(problem.robot.model)
    redundancy = problem.robot.nv - rank(equality_jacobian(problem, numeric.at(q)))
    if redundancy == 0 and best.objective > scale * (1 - 1e-6):
        notes.append("no redundancy left: the constraints alone determine the posture, there is nothing to optimize")
    elif redundancy == 0:
        notes.append("no redundancy left: this is the best of the isolated postures that satisfy the constraints")
    elif best.objective > scale * (1 - _NO_GAIN):
        note = "no better posture found: the initial posture is already optimal for this impact, or nearly so"
        other = np.linalg.norm(wrapped_difference(problem, initial, q)) > SAME_POSTURE
        notes.append(f"{note}; the posture shown is another posture with equal objective" if other else note)
    hits_of = {id(run): count for run, count in zip(runs, hits, strict=True)}
    ends = [(r.record.q, r.objective) for r in good if r.record]
    optima = distinct(problem, ends, [hits_of[id(r)] for r in good if r.record], scale)
    notes += notes_on_impacts(problem.objective, initial, q)
    if touching:
        count = len(certified) - len(good)
        notes.append(f"{count} certified postures were left out, because original shapes touch there: {touching}")
    dominated, certain = sum(r.dominated for r in runs), {*map(id, good)}
    ended = [run.objective if id(run) in certain else None for run in runs]
    estimate = _estimate(ended, dominated, screening)
    if estimate.hits_of_best <= 1 and estimate.starts >= _MANY:
        notes.append("at most one start ended at the best optimum: more `starts` may find a better one")
    return PostureSolution(
        problem=problem,
        initial=initial,
        moved=float(np.linalg.norm(pin.difference(problem.robot.model, problem.given, initial))),
        q=q,
        certificate=certificate,
        redundancy=redundancy,
        optima=optima,
        estimate=estimate,
        starts=starts,
        feasible_starts=sum(r.start is not None for r in runs),
        certified_starts=len(good),
        colliding_starts=len(certified) - len(good),
        dominated_starts=dominated,
        status=best.record.status,
        iterations=best.record.iterations,
        solve_time_s=time.perf_counter() - began - search.build_time_s,
        start_time_s=float(np.median([r.time_s for r in runs])),
        build_time_s=search.build_time_s,
        compiled=nlp.compiled,
        notes=(*problem.notes, *notes),
        compiler_fault=nlp.compiler_fault,
    )


def _without_collisions(problem: ConstrainedProblem, runs: list[SolverRun]) -> tuple[list[SolverRun], str]:
    """Return the runs without a collision at the end, and the names of two shapes that collide in another run."""
    if problem.surroundings is None:
        return runs, ""
    good: list[SolverRun] = []
    touching, checked = "", list[tuple[Array, list[tuple[str, str]]]]()
    for run in runs:
        assert run.record is not None  # noqa: S101 (narrows a type)
        q = run.record.q
        # Check equal final postures only once.
        same = (pairs for other, pairs in checked if np.linalg.norm(wrapped_difference(problem, other, q)) < 1e-6)
        pairs = next(same, None)
        if pairs is None:
            pairs = problem.surroundings.collisions(q)
            checked.append((q, pairs))
        if pairs:
            touching = " / ".join(pairs[0])
        else:
            good.append(run)
    return good, touching


def distinct(
    problem: ConstrainedProblem,
    ends: list[tuple[Array, float]],
    hits: Sequence[int] | None = None,
    scale: float | None = None,
) -> tuple[Optimum, ...]:
    """Group final postures, given with their objectives, by optimum; the best objective comes first.

    ``hits`` contains the number of starts that ended at each posture, by default one.  Objectives that differ by less
    than 1e-9 of ``scale`` count as equal, and keep the order of ``ends``.
    """
    optima: list[Optimum] = []
    weighted = [(*end, count) for end, count in zip(ends, hits or [1] * len(ends), strict=True)]
    for q, objective, count in sorted(weighted, key=lambda end: round(end[1] / scale, _DIGITS) if scale else end[1]):
        for k, known in enumerate(optima):
            near = abs(objective - known.objective) <= _SAME_OBJECTIVE * max(abs(known.objective), 1e-300)
            if near and np.linalg.norm(wrapped_difference(problem, known.q, q)) < SAME_POSTURE:
                optima[k] = replace(known, hits=known.hits + count)
                break
        else:
            optima.append(Optimum(q, objective, count))
    return tuple(optima)


def _estimate(ended: Sequence[float | None], dominated: int, screening: Screening | None) -> SearchEstimate:
    """Estimate unseen optima from the objectives where the runs ended; ``None`` for runs without a result.

    The last runs are those of the screened guesses.  IPOPT can bring guesses with different objectives to the same
    optimum, so their hits are added.  The postures are not compared, because postures on a flat optimum differ.
    """
    count = len(ended) - (0 if screening is None else len(screening.guesses))
    ends, given = [(objective, 1) for objective in ended[:count] if objective is not None], 0
    # The ends of the dominated starts are unknown, so each counts as an objective with one hit.
    others = [1] * dominated
    if screening is not None:
        given, rest, best = len(ends), dict(enumerate(screening.values)), dict[int, float]()
        for group, hits, objective in zip(screening.groups, screening.hits, ended[count:], strict=True):
            if objective is not None:
                ends.append((objective, hits))
                rest[group] -= hits
                best[group] = min(objective, best.get(group, np.inf))
        if not screening.partial:
            # Descents that ended at the objective of a guess, but at other postures, have the same objective.
            ends += [(objective, rest.pop(group)) for group, objective in best.items()]
        others = [hits for group, hits in rest.items() if hits or group not in best]
    objectives, counts = zip(*ends, strict=True)
    distinct_hits = hits_by_value(np.array(objectives) / max(abs(min(objectives)), 1e-300), counts)
    if screening is None:
        return SearchEstimate.of("multistart", [*distinct_hits, *others], bound=dominated > 0)
    # Descents stop early in flat valleys, so the estimated fraction of unseen optima is probably too high.
    return SearchEstimate.of(
        "adaptive", [*distinct_hits, *others], screening.hops, bound=True, partial=screening.partial, given=given
    )


def wrapped_difference(problem: ConstrainedProblem, one: Array, other: Array) -> Array:
    """Return ``other ⊖ one``, shape (nv,), with the angles of revolute joints wrapped to ±π."""
    step = np.array(pin.difference(problem.robot.model, one, other))
    for slot in Chart.of(problem.robot.model).slots:
        if slot.kind.family == "revolute":
            step[slot.v] = (step[slot.v] + np.pi) % (2 * np.pi) - np.pi
    return step


def _failure(problem: ConstrainedProblem, runs: list[SolverRun]) -> SolverFailed:
    solved = [(r.record, r.certificate) for r in runs if r.record is not None and r.certificate is not None]
    if not solved:
        return SolverFailed(
            "the objective is not defined at the postures where the starts ended",
            where="solver",
            hint="choose another `objective`",
        )
    statuses = sorted({record.status for record, _ in solved})
    nearest = min((certificate for _, certificate in solved), key=lambda c: c.stationarity)
    fault = f"none of {len(solved)} feasible starts ended at a certified posture"
    hint = "try more `starts`, another `seed` or `posture`, or a small `regularization`"
    # A posture that violates the constraints may be less singular than all postures that satisfy them.
    held = [record.q for record, certificate in solved if certificate.primal <= FEASIBLE]
    singular = singular_target(problem, [*held, *(run.start for run in runs if run.start is not None)])
    if singular is not None:
        return SolverFailed(f"{fault}: {singular.fact}", where="solver", hint=singular.hint)
    numbers = f"best stationarity {nearest.stationarity:.1e}, violation {nearest.primal:.1e}"
    return SolverFailed(f"{fault} (solver: {', '.join(statuses)}; {numbers})", where="solver", hint=hint)
