"""The runs of the solver from all starts, with a program that grows by what their ends lack."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import MetricError
from impact_posture.posture.certificate import Certificate, certify
from impact_posture.posture.compiled import CompileMode
from impact_posture.posture.nlp import SLACK_PRICE, PostureNLP, SolveRecord, build_nlp, one_blas_thread
from impact_posture.posture.posture_distance import distance
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.starts import feasible_start
from impact_posture.processes import fork_map

Progress = Callable[[int, int], None]

# A constraint with a violation up to this (m, rad) is satisfied.
FEASIBLE = 1e-8
# Starts that run before the others, and most rounds in which the program grows.
_FIRST, _ROUNDS = 2, 8
# Price of a meter of slack for runs that ended in a trap.
HIGH_PRICE = 20 * SLACK_PRICE


@dataclass(frozen=True)
class Run:
    """A run of the solver from one start.

    Attributes:
        start: The start; ``None`` if none reached the constraints.
        record: Result of the solver; ``None`` if the objective does not exist at its end.
        objective: Objective at the end.
        minimized: Objective in units of the initial one, with the regularization.
        certificate: Certificate of the end.
    """

    start: Array | None = None
    record: SolveRecord | None = None
    objective: float = np.inf
    minimized: float = np.inf
    certificate: Certificate | None = None

    @property
    def good(self) -> bool:
        """Whether the end is certified."""
        return self.certificate is not None and self.certificate.holds()


@one_blas_thread()
def run_start(
    nlp: PostureNLP, start: Array, scale: float, price: float = SLACK_PRICE
) -> tuple[SolveRecord, Certificate]:
    """Solve from a feasible start and certify the end; try the other guesses of the objective if it fails."""
    record = nlp.solve(start, scale=scale, price=price)
    certificate = certify(nlp.problem, record.q, scale, record.auxiliaries, nlp.program.numeric)
    for attempt in range(1, nlp.problem.objective.attempts):
        if certificate.holds():
            break
        again = nlp.solve(start, scale=scale, attempt=attempt, price=price)
        certificate = certify(nlp.problem, again.q, scale, again.auxiliaries, nlp.program.numeric)
        record = replace(
            again,
            iterations=record.iterations + again.iterations,
            time_s=record.time_s + again.time_s,
            cpu_s=record.cpu_s + again.cpu_s,
        )
    return record, certificate


class Search:
    """The runs from all starts, whose program gets what it lacks until no end of a run lacks anything.

    Args:
        problem: The posture problem.
        known: The first starts.
        scale: The initial objective.
        starts: Number of starts.
        seed: Seed of the starts that are not known.
        compile: Whether to compile the program.
    """

    def __init__(
        self,
        problem: PostureProblem,
        known: tuple[Array, ...],
        scale: float,
        *,
        starts: int,
        seed: int,
        compile: CompileMode,
    ) -> None:
        self.problem, self._known, self._scale, self._seed, self._compile = problem, known, scale, seed, compile
        self._starts = starts
        self.nlp = build_nlp(problem, compile=compile, starts=starts)
        self.build_time_s = self.nlp.build_time_s
        # A run goes on from where it ended without what the program lacked.
        self._ends: dict[int, Array] = {}
        self._trapped: set[int] = set()

    def run(self, jobs: int, progress: Progress | None) -> list[Run]:
        """Run all starts; those whose ends the program did not keep feasible run again with what it lacked."""
        runs: dict[int, Run] = {}
        starts = self._starts
        # What the first starts lack is what most others will.
        waiting, later = list(range(starts)), []
        if self.problem.grows and starts > _FIRST:
            waiting, later = waiting[:_FIRST], waiting[_FIRST:]
        for _ in range(_ROUNDS):
            for index, run in self._round(waiting, jobs):
                runs[index] = run
                if progress:
                    progress(min(len(runs), starts), starts)
            records = {k: runs[k].record for k in waiting}
            ends = {k: record.q for k, record in records.items() if record is not None and record.converged}
            lacking = {k: q for k, q in ends.items() if self.problem.grown([q]) is not self.problem}
            # An end that lacks nothing and still violates something is a trap, and a higher price may lead out of it.
            again = {k: q for k, q in ends.items() if k not in lacking and k not in self._trapped}
            trapped = {k for k, q in again.items() if not feasible(self.problem, q)}
            self._trapped |= trapped
            self._ends |= lacking | {k: ends[k] for k in trapped}
            waiting = sorted({*lacking, *trapped, *later})
            if lacking:
                self.problem = self.problem.grown(list(lacking.values()))
                self.nlp = self.nlp.grown(self.problem, compile=self._compile)
                self.build_time_s += self.nlp.build_time_s
            if not waiting:
                break
            later = []
        return [runs[index] for index in range(starts)]

    def _round(self, waiting: list[int], jobs: int) -> Iterator[tuple[int, Run]]:
        # A fork takes longer than three starts.
        with fork_map(lambda k: self._run(waiting[k]), len(waiting), jobs if len(waiting) > 3 else 1) as results:
            for k, run in results:
                yield waiting[k], run

    def _run(self, index: int) -> Run:
        nlp, scale, problem = self.nlp, self._scale, self.problem
        start = self._ends.get(index)
        if start is None:
            start = self._known[index] if index < len(self._known) else feasible_start(problem, index, self._seed)
        if start is None:
            return Run()
        try:
            record, certificate = run_start(nlp, start, scale, HIGH_PRICE if index in self._trapped else SLACK_PRICE)
            objective = problem.objective.value(record.q)
        except MetricError:
            # This start led to a posture where the objective does not exist.  The other starts go on.
            return Run(start)
        minimized = objective / scale
        if problem.requirements.regularization:
            minimized += problem.requirements.regularization * distance(nlp.chart, record.q, problem.given) ** 2
        return Run(start, record, objective, minimized, certificate)


def feasible(problem: PostureProblem, q: Array) -> bool:
    """Return whether ``q`` satisfies all constraints, those of the program and others."""
    violations = problem.violations(Numeric(problem.robot.model).at(q))
    return all(float(np.abs(excess).max(initial=0.0)) <= FEASIBLE for excess in violations)
