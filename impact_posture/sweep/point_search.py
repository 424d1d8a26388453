"""Solution of one point of a sweep: warm starts, random starts where they disagree, and a certificate or a reason."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from impact_posture.config.problem_settings import ProblemSettings
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

# Most rounds in which the program of a point grows, and most rounds before the point is known to be feasible.
_ROUNDS, _UNSURE = 8, 3
# Postures whose joints differ by more than this (rad, m) may belong to different optima.
SWITCH = 0.2
# An optimum is better than another one if its objective is lower by this share.
_BETTER = 1e-4

# Position and orientation of the contact frame; ``None`` keeps the value at the given posture.
Place = tuple[Any, Any]


class Start(NamedTuple):
    """Start posture, shape (nq,), with the end of the solver run that led to it, if known."""

    q: Array
    end: WarmStart | None = None


class PointResult(NamedTuple):
    """Result of one point.

    Attributes:
        row: Columns of the point in the table.
        start: Posture of the point, as a start for other points; ``None`` without a posture.
        violation: Least known violation, weighted by the prices of the constraints, if the point is infeasible.
    """

    row: dict[str, Any]
    start: Start | None = None
    violation: float = 0.0

    @property
    def q(self) -> Array | None:
        """Posture of the point, shape (nq,), or ``None``."""
        return self.start and self.start.q


@dataclass
class Timer:
    """Wall time within IPOPT and the functions that it calls, s."""

    solver_s: float = 0.0


class Walk:
    """Problem and program of a template, which grow from point to point of a shard."""

    def __init__(
        self, template: ConstrainedProblem, settings: ProblemSettings, nlp: PostureNLP, timer: Timer
    ) -> None:
        # Keep the template alive, because a shard identifies it by its ``id``.
        self._template, self.settings, self.timer = template, settings, timer
        self.problem, self.nlp = template, nlp
        self._relaxed: ElasticProgram | None = None

    def grow(self, problem: ConstrainedProblem) -> None:
        """Continue with a problem that has more parts."""
        self.problem, self.nlp = problem, self.nlp.grown(problem, compile="never")

    def at(self, problem: ConstrainedProblem, place: Place) -> ConstrainedProblem:
        """Return a problem with another target."""
        return retarget(problem, *place, self.nlp.program.numeric)

    def relax(self, place: Place, guesses: Sequence[Array] = (), beside: float = 0.0) -> LeastViolation:
        """Relax the constraints at a target, in a program that has grown at earlier targets."""
        program = self._relaxed = self._relaxed or ElasticProgram(self.problem, self.nlp.program.rows.branch())
        before = program.time_s
        violation = find_conflicts(self.at(program.problem, place), self.settings.seed, program, guesses, beside)
        self.timer.solver_s += program.time_s - before
        return violation


def search(walk: Walk, place: Place, guesses: Sequence[Start], beside: float = 0.0) -> PointResult:
    """Solve one point from optima of neighbors and the given posture, and from many starts where they disagree.

    ``beside`` is the least violation at infeasible neighbors, if no neighbor has an optimum.  This point is then
    likely infeasible.
    """
    attempt = _Attempt(walk, place, walk.settings.starts - 1)
    try:
        if not beside and (result := attempt.certified(guesses, rounds=_UNSURE)) is not None:
            return result
        # The relaxed problem has either conflicting constraints or a posture to start from.
        relaxed = walk.relax(place, [guess.q for guess in guesses], beside)
        if relaxed.conflicts:
            return attempt.failure("infeasible", Infeasible(relaxed.conflicts).what, relaxed.violation)
        result = attempt.certified([Start(relaxed.q)]) or attempt.searched(relaxed.q)
        return result or attempt.failure("uncertified", attempt.fault)
    except ImpactPostureError as error:
        return attempt.failure("undefined", error.line)


def improve(walk: Walk, place: Place, known: PointResult, guess: Start) -> PointResult:
    """Return the better of a known result and the optimum from the posture of a neighbor."""
    # The base of a floating robot follows the target, so its position does not distinguish optima.
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
    """Solver runs at one point, with the number of random starts where the first starts disagree."""

    def __init__(self, walk: Walk, place: Place, others: int) -> None:
        self.problem, self.runs, self.fault = walk.at(walk.problem, place), 0, "no run converged"
        self._walk, self._others = walk, others

    def certified(
        self, guesses: Sequence[Start], *, alone: bool = False, rounds: int = _ROUNDS
    ) -> PointResult | None:
        """Return the best certified result from the guesses and, if they are not ``alone``, from other starts.

        The program grows by the parts that the ends of the runs need, in at most ``rounds`` rounds.
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
                # No part is missing, but a constraint is violated: the run is trapped.
                price = HIGH_PRICE
            else:
                return None
        return None

    def searched(self, guess: Array) -> PointResult | None:
        """Return the result of ``optimize``, which starts again where a run ends between bodies."""
        settings = self._walk.settings
        try:
            solution = solve(
                self.problem, starts=settings.starts, seed=settings.seed, jobs=1, compile="never", guesses=[guess]
            )
        except (Infeasible, SolverFailed) as error:
            self.fault = error.what
            return None
        self.runs += solution.feasible_starts
        return self._answer(Start(solution.q), solution.certificate, len(solution.optima))

    def _random_starts(self) -> Iterator[Start]:
        """Yield random postures whose projection satisfies the constraints."""
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
        """Return the result of a point without posture."""
        row = {"status": status, "reason": reason, "optima": 0, "runs": self.runs}
        return PointResult(row, violation=violation)


class _End(NamedTuple):
    """End of a solver run.  The value is the minimized objective, or infinite if the run did not converge."""

    q: Array
    value: float
    auxiliaries: Array
    end: WarmStart


def _optima(problem: ConstrainedProblem, ends: Sequence[_End]) -> list[_End]:
    """Return an end for each distinct optimum, the best first."""
    by_posture = {id(end.q): end for end in ends}
    return [
        by_posture[id(optimum.q)]
        for optimum in distinct(problem, [(e.q, e.value) for e in ends if np.isfinite(e.value)])
    ]


def _agree(problem: ConstrainedProblem, ends: Sequence[_End], home: _End) -> bool:
    """Whether all neighbors lead to one optimum, and the given posture does not lead to a better one."""
    if not ends or not all(np.isfinite(end.value) for end in ends):
        return False
    return len(_optima(problem, ends)) == 1 and home.value > (1 - _BETTER) * min(end.value for end in ends)
