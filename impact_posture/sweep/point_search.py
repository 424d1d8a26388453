"""Solve one point of a sweep: warm starts, random starts where they disagree, a certificate, or the reason."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from impact_posture.config.settings import ProblemSettings
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

# Most rounds in which the program of a point grows, and most of them before anything says that the point is feasible.
_ROUNDS, _UNSURE = 8, 3
# Postures whose joints differ by more than this (rad, m) may be of different optima.
SWITCH = 0.2
# An optimum is better than another if its objective is lower by this share.
_BETTER = 1e-4

# Position and orientation of the contact frame; ``None`` where it is at the given posture.
Place = tuple[Any, Any]


class Start(NamedTuple):
    """A posture to start from, shape (nq,), with the end of the run that led to it if that is known."""

    q: Array
    end: WarmStart | None = None


class PointResult(NamedTuple):
    """The answer to one problem.

    Attributes:
        row: Its columns in the table.
        start: Its posture, if there is one, as a start for other points.
        violation: Least violation that could be found, at the prices of the constraints, if it is infeasible.
    """

    row: dict[str, Any]
    start: Start | None = None
    violation: float = 0.0

    @property
    def q(self) -> Array | None:
        """Its posture, shape (nq,), if there is one."""
        return self.start and self.start.q


@dataclass
class Timer:
    """Wall time within IPOPT and the functions that it calls, s."""

    solver_s: float = 0.0


class Walk:
    """Problem and program of one template on its way through a shard, where both may grow.

    Args:
        template: The problem with the normal and the speed of some points.
        settings: Number of starts, and their seed.
        nlp: Its program, which nothing else lets grow.
        timer: Where the time of the solver is added.
    """

    def __init__(
        self, template: ConstrainedProblem, settings: ProblemSettings, nlp: PostureNLP, timer: Timer
    ) -> None:
        # The template is kept, because a shard knows it by its identity.
        self._template, self.settings, self.timer = template, settings, timer
        self.problem, self.nlp = template, nlp
        self._relaxed: ElasticProgram | None = None

    def grow(self, problem: ConstrainedProblem) -> None:
        """Go on with the parts that a point needed."""
        self.problem, self.nlp = problem, self.nlp.grown(problem, compile="never")

    def at(self, problem: ConstrainedProblem, place: Place) -> ConstrainedProblem:
        """Return a problem with its target at a place."""
        return retarget(problem, *place, self.nlp.program.numeric)

    def relax(self, place: Place, guesses: Sequence[Array] = (), beside: float = 0.0) -> LeastViolation:
        """Relax the constraints at a place, with the parts that the places before needed for it."""
        program = self._relaxed = self._relaxed or ElasticProgram(self.problem, self.nlp.program.rows.branch())
        before = program.time_s
        found = find_conflicts(self.at(program.problem, place), self.settings.seed, program, guesses, beside)
        self.timer.solver_s += program.time_s - before
        return found


def search(walk: Walk, place: Place, guesses: Sequence[Start], beside: float = 0.0) -> PointResult:
    """Solve one point: from the guesses and the given posture, and from many starts where they disagree.

    Args:
        walk: Problem and program as the points before have left them.
        place: Target position and orientation.
        guesses: Optima of neighbors.
        beside: Least violation at infeasible neighbors if none has an optimum.  This point is likely infeasible too.
    """
    attempt = _Attempt(walk, place, walk.settings.starts - 1)
    try:
        if not beside and (found := attempt.certified(guesses, rounds=_UNSURE)) is not None:
            return found
        # Either this finds the constraints that conflict, or a posture to start from.
        relaxed = walk.relax(place, [guess.q for guess in guesses], beside)
        if relaxed.conflicts:
            return attempt.without("infeasible", Infeasible(relaxed.conflicts).what, relaxed.violation)
        found = attempt.certified([Start(relaxed.q)]) or attempt.searched(relaxed.q)
        return found or attempt.without("uncertified", attempt.fault)
    except ImpactPostureError as error:
        return attempt.without("undefined", error.line)


def improve(walk: Walk, place: Place, known: PointResult, guess: Start) -> PointResult:
    """Return the better of a known answer and of the optimum that the posture of a later neighbor leads to."""
    # The base of a robot that floats follows the target, which is no other optimum.
    own = slice(3 if walk.problem.robot.floating else 0, None)
    if known.q is not None and np.abs(known.q - guess.q)[own].max() < SWITCH:
        return known
    attempt = _Attempt(walk, place, 0)
    try:
        found = attempt.certified([guess], alone=True)
    except ImpactPostureError:
        found = None
    if found is None or (known.q is not None and found.row["value"] > (1 - _BETTER) * known.row["value"]):
        return known
    counts = {key: known.row[key] + found.row[key] for key in ("optima", "runs")}
    return PointResult({**found.row, **counts}, found.start)


class _Attempt:
    """The runs at one point.

    Args:
        walk: Problem and program of the template, which this grows.
        place: Target position and orientation.
        others: Number of random starts where the first ones disagree.

    Attributes:
        problem: The problem at this point.
        runs: Number of runs.
        fault: What the last posture that failed its certificate lacks.
    """

    def __init__(self, walk: Walk, place: Place, others: int) -> None:
        self.problem, self.runs, self.fault = walk.at(walk.problem, place), 0, "no run converged"
        self._walk, self._others = walk, others

    def certified(
        self, guesses: Sequence[Start], *, alone: bool = False, rounds: int = _ROUNDS
    ) -> PointResult | None:
        """Return the best certified posture, with parts added to the program as its ends need them.

        Args:
            guesses: Where the runs start, besides the given posture and the random ones.
            alone: Whether nothing else is started from.
            rounds: Most rounds in which the program grows.
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
            found = _optima(problem, ends)
            for end in found:
                certificate = certify(problem, end.q, scale, end.auxiliaries, nlp.program.numeric)
                if certificate.holds() and self._is_clear(end.q):
                    return self._answer(Start(end.q, end.end), certificate, len(found))
                self.fault = f"stationarity {certificate.stationarity:.1e}, violation {certificate.primal:.1e}"
            if not found:
                return None
            guesses = [Start(end.q) for end in found]
            own = [end.auxiliaries for end in found]
            self.problem = problem.grown([end.q for end in found], nlp.program.numeric, own)
            if self.problem is not problem:
                self._walk.grow(self.problem)
            elif price == SLACK_PRICE:
                # An end that lacks nothing and still violates something is a trap.
                price = HIGH_PRICE
            else:
                return None
        return None

    def searched(self, guess: Array) -> PointResult | None:
        """Return what ``optimize`` finds, which starts anew where a run ends between bodies."""
        settings = self._walk.settings
        try:
            found = solve(
                self.problem, starts=settings.starts, seed=settings.seed, jobs=1, compile="never", guesses=[guess]
            )
        except (Infeasible, SolverFailed) as error:
            self.fault = error.what
            return None
        self.runs += found.feasible_starts
        return self._answer(Start(found.q), found.certificate, len(found.optima))

    def _random_starts(self) -> Iterator[Start]:
        """Yield random postures that one projection takes to the constraints."""
        projector = Projector(self.problem)
        for k in range(1, self._others + 1):
            rng = np.random.default_rng([self._walk.settings.seed, k])
            near = self.problem.given if k % 2 else None
            found = projector.project(random_posture(self.problem, projector.chart, rng, near))
            if found.violation <= FEASIBLE:
                yield Start(found.q)

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
        found = self.problem.impact.oracle.quantities(q)
        row = {
            "status": "certified",
            "q": q.tolist(),
            "value": self.problem.objective.value(q),
            **{key: getattr(found, key) for key in "HGVSE"},
            "stationarity": certificate.stationarity,
            "violation": certificate.primal,
            "optima": optima,
            "runs": self.runs,
        }
        return PointResult(row, start)

    def without(self, status: str, reason: str, violation: float = 0.0) -> PointResult:
        """Return the answer that there is no posture."""
        row = {"status": status, "reason": reason, "optima": 0, "runs": self.runs}
        return PointResult(row, violation=violation)


class _End(NamedTuple):
    """End of a run; the value, with what the program adds to the objective, is infinite if it did not converge."""

    q: Array
    value: float
    auxiliaries: Array
    end: WarmStart


def _optima(problem: ConstrainedProblem, ends: Sequence[_End]) -> list[_End]:
    """Return one end for each distinct optimum, the best first."""
    known = {id(end.q): end for end in ends}
    return [known[id(one.q)] for one in distinct(problem, [(e.q, e.value) for e in ends if np.isfinite(e.value)])]


def _agree(problem: ConstrainedProblem, ends: Sequence[_End], home: _End) -> bool:
    """Whether all neighbors lead to one optimum, and the given posture leads to no better one."""
    if not ends or not all(np.isfinite(end.value) for end in ends):
        return False
    return len(_optima(problem, ends)) == 1 and home.value > (1 - _BETTER) * min(end.value for end in ends)
