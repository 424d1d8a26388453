"""Solve one grid point of a sweep from warm starts, and from random starts if warm starts lead to different optima.

The result has a certificate, or the reason why no posture is certified.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from impact_posture.config.problem_settings import STARTS, ProblemSettings
from impact_posture.errors import ImpactPostureError, Infeasible, SolverFailed
from impact_posture.posture.formulation.build_problem import retarget
from impact_posture.posture.manifold.feasible_start import FEASIBLE, Projector, random_posture
from impact_posture.posture.program.certificate import Certificate, certify
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import SLACK_PRICE, PostureNLP, WarmStart
from impact_posture.posture.search.conflicts import ElasticProgram, LeastViolation, find_conflicts
from impact_posture.posture.search.growing_search import HIGH_PRICE
from impact_posture.posture.search.multistart import distinct, solve
from impact_posture.system.arrays import Array

# ``_ROUNDS`` is the maximum number of rounds that add missing body pairs to the nonlinear program of a point.  While
# it is unknown whether the point is feasible, at most ``_UNSURE`` rounds are made.
_ROUNDS, _UNSURE = 8, 3
# Postures whose joints differ by more than this (rad, m) may belong to different optima.
SWITCH = 0.2
# A new optimum replaces the known optimum only if it lowers the objective by at least this fraction.
_BETTER = 1e-4

# Target position and orientation of the contact frame; ``None`` to keep the value at the given posture.
Place = tuple[Any, Any]


class Start(NamedTuple):
    """Start posture ``q``, shape (nq,), and ``end``, the state of a solver that ended at ``q`` (or ``None``)."""

    q: Array
    end: WarmStart | None = None


class PointResult(NamedTuple):
    """Result of one point.

    Attributes:
        row: Column name → value of the grid point in the table.
        start: Posture of the grid point, from which other points can start; ``None`` if the point has no posture.
        violation: Smallest known weighted sum of all constraint violations; 0 if the grid point is not infeasible.
    """

    row: dict[str, Any]
    start: Start | None = None
    violation: float = 0.0

    @property
    def q(self) -> Array | None:
        """Posture of the grid point, shape (nq,); ``None`` if the point has no posture."""
        return self.start and self.start.q


@dataclass
class Timer:
    """Timer of the wall time in IPOPT and in the functions that IPOPT calls, s."""

    solver_s: float = 0.0


class Walk:
    """Problem and nonlinear program for grid points of a shard that differ only in the target.

    If a point needs more body pairs, problem and program are extended for this and the next points.
    """

    def __init__(
        self, template: ConstrainedProblem, settings: ProblemSettings, nlp: PostureNLP, timer: Timer
    ) -> None:
        # The caller identifies the template by its ``id``.  ``_template`` keeps the object alive, so that no other
        # object gets the same ``id``.
        self._template, self.settings, self.timer = template, settings, timer
        self.problem, self.nlp = template, nlp
        self._relaxed: ElasticProgram | None = None

    def grow(self, problem: ConstrainedProblem) -> None:
        """Use ``problem``, which has additional body pairs, for the present point and all later points."""
        self.problem, self.nlp = problem, self.nlp.grown(problem, compile="never")

    def at(self, problem: ConstrainedProblem, place: Place) -> ConstrainedProblem:
        """Return the problem with the target ``place``."""
        return retarget(problem, *place, self.nlp.program.numeric)

    def relax(self, place: Place, guesses: Sequence[Array] = (), beside: float = 0.0) -> LeastViolation:
        """Minimize the violation of the constraints at a target.

        ``beside`` is the smallest violation at neighboring points.  The program keeps body pairs that earlier targets
        needed.
        """
        program = self._relaxed = self._relaxed or ElasticProgram(self.problem, self.nlp.program.rows.branch())
        before = program.time_s
        violation = find_conflicts(self.at(program.problem, place), self.settings.seed, program, guesses, beside)
        self.timer.solver_s += program.time_s - before
        return violation


def search(walk: Walk, place: Place, guesses: Sequence[Start], beside: float = 0.0) -> PointResult:
    """Solve one grid point from the optima of its neighbors and from the given posture.

    If these initial postures lead to different optima, random initial postures are added.  ``beside`` is the smallest
    violation at infeasible neighbors, or 0 if a neighbor has an optimum.  If ``beside`` is positive, the point is
    probably infeasible.
    """
    attempt = _Attempt(walk, place, (walk.settings.starts or STARTS) - 1)
    try:
        if not beside and (result := attempt.certified(guesses, rounds=_UNSURE)) is not None:
            return result
        # The result of the relaxed problem is either a set of conflicting constraints, or a start posture.
        relaxed = walk.relax(place, [guess.q for guess in guesses], beside)
        if relaxed.conflicts:
            return attempt.failure("infeasible", Infeasible(relaxed.conflicts, relaxed.sizes).what, relaxed.violation)
        result = attempt.certified([Start(relaxed.q)]) or attempt.searched(relaxed.q)
        return result or attempt.failure("uncertified", attempt.fault)
    except ImpactPostureError as error:
        return attempt.failure("undefined", error.line)


def improve(walk: Walk, place: Place, known: PointResult, guess: Start) -> PointResult:
    """Solve a grid point from the posture of a neighbor; return the known result if the new result is not better."""
    # The base of a floating robot moves with the target, so the position of the base does not distinguish optima.
    first = 3 if walk.problem.robot.floating else 0
    if known.q is not None and np.abs(known.q - guess.q)[first:].max() < SWITCH:
        return known
    attempt = _Attempt(walk, place, 0)
    try:
        result = attempt.certified([guess], alone=True)
    except ImpactPostureError:
        result = None
    if result is None or (known.q is not None and result.row["value"] > (1 - _BETTER) * known.row["value"]):
        return known
    counts = {key: known.row[key] + result.row[key] for key in ("optima", "runs")}
    return PointResult({**result.row, **counts}, result.start)


class _Attempt:
    """Solver runs at a grid point; ``others`` random starts are added if the first starts disagree."""

    def __init__(self, walk: Walk, place: Place, others: int) -> None:
        self.problem, self.runs, self.fault = walk.at(walk.problem, place), 0, "no run converged"
        self._walk, self._others = walk, others

    def certified(
        self, guesses: Sequence[Start], *, alone: bool = False, rounds: int = _ROUNDS
    ) -> PointResult | None:
        """Return the best certified result, or ``None``.

        With ``alone``, the runs start only from ``guesses``.  Otherwise, a run also starts from the given posture of
        the problem.  If the results differ, random starts are added.  After each of at most ``rounds`` rounds, the
        program gets the body pairs that violate their clearance at the results.
        """
        price = SLACK_PRICE
        for _ in range(rounds):
            problem = self.problem
            nlp = self._walk.nlp.at(problem)
            home = Start(problem.given)
            scale = problem.objective.value((guesses[0] if guesses else home).q)
            ends = [self._run(nlp, start, scale, price) for start in (guesses if alone else [*guesses, home])]
            if not alone and not _agree(problem, ends[:-1], ends[-1]):
                ends += [self._run(nlp, start, scale, price) for start in self._random_starts()]
            optima = _optima(problem, ends)
            for end in optima:
                certificate = certify(problem, end.q, scale, end.auxiliaries, nlp.program.numeric)
                if certificate.holds() and self._is_clear(end.q):
                    return self._answer(Start(end.q, end.end), certificate, len(optima))
                self.fault = f"stationarity {certificate.stationarity:.1e}, violation {certificate.primal:.1e}"
            if not optima:
                return None
            guesses = [Start(end.q) for end in optima]
            auxiliaries = [end.auxiliaries for end in optima]
            self.problem = problem.grown([end.q for end in optima], nlp.program.numeric, auxiliaries)
            if self.problem is not problem:
                self._walk.grow(self.problem)
            elif price == SLACK_PRICE:
                # The program contains all violated body pairs, but a constraint is still violated.  The solver is
                # therefore in a local minimum of the violation.  Try again with a higher penalty on violations.
                price = HIGH_PRICE
            else:
                return None
        return None

    def searched(self, guess: Array) -> PointResult | None:
        """Return the result of the multistart search of ``optimize``, which also restarts from collisions."""
        settings = self._walk.settings
        try:
            solution = solve(
                self.problem,
                starts=settings.starts or STARTS,
                seed=settings.seed,
                jobs=1,
                compile="never",
                guesses=[guess],
            )
        except (Infeasible, SolverFailed) as error:
            self.fault = error.what
            return None
        self.runs += solution.feasible_starts
        return self._answer(Start(solution.q), solution.certificate, len(solution.optima))

    def _random_starts(self) -> Iterator[Start]:
        """Yield projections of random postures onto the constraints, if the projection succeeds."""
        projector = Projector(self.problem)
        for k in range(1, self._others + 1):
            rng = np.random.default_rng([self._walk.settings.seed, k])
            near = self.problem.given if k % 2 else None
            projected = projector.project(random_posture(self.problem, projector.chart, rng, near))
            if projected.violation <= FEASIBLE:
                yield Start(projected.q)

    def _run(self, nlp: PostureNLP, start: Start, scale: float, price: float) -> _End:
        record = nlp.solve(start.q, scale=scale, price=price, warm=start.end)
        self.runs += 1
        self._walk.timer.solver_s += record.time_s
        value = scale * record.minimized if record.converged else np.inf
        return _End(record.q, value, record.auxiliaries, record.end)

    def _is_clear(self, q: Array) -> bool:
        around = self.problem.surroundings
        return self.problem.objective.movable(q) and not (around and around.collisions(q))

    def _answer(self, start: Start, certificate: Certificate, optima: int) -> PointResult:
        q = start.q
        quantities = self.problem.impact.oracle.quantities(q)
        row = {
            "status": "certified",
            "q": q.tolist(),
            "value": self.problem.objective.value(q),
            **{key: getattr(quantities, key) for key in "HGVSE"},
            "stationarity": certificate.stationarity,
            "violation": certificate.primal,
            "optima": optima,
            "runs": self.runs,
        }
        return PointResult(row, start)

    def failure(self, status: str, reason: str, violation: float = 0.0) -> PointResult:
        """Return the result of a grid point without a certified posture."""
        row = {"status": status, "reason": reason, "optima": 0, "runs": self.runs}
        return PointResult(row, violation=violation)


class _End(NamedTuple):
    """End of a solver run.  ``value`` is the minimized objective, or infinite if the run did not converge."""

    q: Array
    value: float
    auxiliaries: Array
    end: WarmStart


def _optima(problem: ConstrainedProblem, ends: Sequence[_End]) -> list[_End]:
    by_posture = {id(end.q): end for end in ends}
    return [
        by_posture[id(optimum.q)]
        for optimum in distinct(problem, [(e.q, e.value) for e in ends if np.isfinite(e.value)])
    ]


def _agree(problem: ConstrainedProblem, ends: Sequence[_End], home: _End) -> bool:
    """Return whether the runs ``ends`` have the same optimum, and the run ``home`` has no better optimum."""
    if not ends or not all(np.isfinite(end.value) for end in ends):
        return False
    return len(_optima(problem, ends)) == 1 and home.value > (1 - _BETTER) * min(end.value for end in ends)
