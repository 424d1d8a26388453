"""Runs of the solver from all starts; rows that a final posture violates are added to the program."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import MetricError
from impact_posture.posture.constraints.posture_distance import distance
from impact_posture.posture.manifold.feasible_start import FEASIBLE
from impact_posture.posture.program.certificate import Certificate, certify
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.posture.program.posture_nlp import SLACK_PRICE, PostureNLP, SolveRecord, build_nlp
from impact_posture.posture.program.program_rows import ProgramRows
from impact_posture.posture.search.start_draws import StartDraws
from impact_posture.system.arrays import Array
from impact_posture.system.processes import fork_map

Progress = Callable[[int, int], None]

# Number of starts that run before all others, if rows can be added to the program.
FIRST = 2
# Maximum number of runs from one start; before each further run, missing rows are added to the program.
_ROUNDS = 10
# If all starts together have at most this number of unknowns, every start is finished, because stopping starts would
# save no time.
_SMALL = 1000
# Largest total number of unknowns of the starts that run together.  With more starts, the program would get rows that
# the best starts do not need.
_BATCH = 600
# Least number of starts that run together.  With fewer starts, the program would be built more often.
_LEAST = 2
# A start is dominated, and stops, if its objective exceeds the best objective by this fraction.  The fraction is
# large because the repetition of a trapped run (:attr:`SolverRun.trapped`) may end at a lower objective.
_FAR = 0.05
# If the runs together have fewer unknowns than this, they stay in this process, because starting processes would take
# longer.
_FORK = 200
# Starts share one run if the postures from which they continue differ by less than this value (rad, m), because their
# runs would end at the same posture.
_SAME = 1e-6
# Penalty per meter of slack when a trapped run (:attr:`SolverRun.trapped`) is repeated.
HIGH_PRICE = 20 * SLACK_PRICE
# Maximum number of repetitions of a trapped run.
_ANEW = 4
# Factor by which each further repetition raises the penalty.  With a fixed penalty, slack remains if the objective
# decreases steeply, for example near a stretched ur10.
_DEARER = 10


@dataclass(frozen=True)
class SolverRun:
    """A run of the solver from one start.

    Attributes:
        start: Posture from which the run starts, shape (nq,); ``None`` if no attempt reached the constraints.
        record: Result of the solver; ``None`` if the objective is not defined at the final posture.
        objective: Objective at the final posture.
        minimized: Objective divided by the initial objective, plus the regularization.
        certificate: Certificate of the final posture; ``None`` while the program lacks rows.
        lacks: Whether the final posture violates rows that the program lacks.
        dominated: Whether the start was stopped after this run because it could not become the best.
        trapped: Whether the final posture violates a constraint although more rows would not help.  More rows do not
            help if the program already has all rows, or if slack lowers the objective by more than the penalty.  A
            trapped run is repeated with a higher penalty on slack.
        time_s: Wall time of all runs from the start, s; starts that share a run share its time equally.
    """

    start: Array | None = None
    record: SolveRecord | None = None
    objective: float = np.inf
    minimized: float = np.inf
    certificate: Certificate | None = None
    lacks: bool = False
    dominated: bool = False
    trapped: bool = False
    time_s: float = 0.0

    @property
    def good(self) -> bool:
        """Whether the final posture is certified."""
        return self.certificate is not None and self.certificate.holds()


@one_blas_thread()
def run_start(
    nlp: PostureNLP, start: Array, scale: float, price: float = SLACK_PRICE, first: SolveRecord | None = None
) -> tuple[SolveRecord, Certificate]:
    """Solve from a feasible start and certify the result; if that fails, try the other guesses of the objective.

    ``scale`` is the initial objective, ``price`` the penalty per meter of slack, and ``first`` the result of the
    first guess, if the caller has already computed this result.
    """
    record = first or nlp.solve(start, scale=scale, price=price)
    certificate = certify(nlp.problem, record.q, scale, record.auxiliaries, nlp.program.numeric)
    for attempt in range(1, nlp.problem.objective.attempts):
        if certificate.holds():
            break
        again = nlp.solve(start, scale=scale, attempt=attempt, price=price)
        certificate = certify(nlp.problem, again.q, scale, again.auxiliaries, nlp.program.numeric)
        iterations, time_s = record.iterations + again.iterations, record.time_s + again.time_s
        record = replace(again, iterations=iterations, time_s=time_s)
    return record, certificate


class GrowingSearch:
    """Runs from all starts; rows are added to the program, and runs repeated, until no row is missing.

    ``scale`` is the initial objective.  ``finish_all`` also finishes starts that cannot become the best; in small
    programs, such starts are always finished.  ``rows`` may be shared with another program of the same problem.
    """

    def __init__(
        self,
        problem: ConstrainedProblem,
        draws: StartDraws,
        scale: float,
        *,
        compile: CompileMode,
        finish_all: bool,
        rows: ProgramRows | None = None,
    ) -> None:
        self.problem, self._draws, self._scale, self._compile = problem, draws, scale, compile
        self.nlp = build_nlp(problem, compile=compile, starts=draws.count, rows=rows)
        self._small = draws.count * self._unknowns <= _SMALL
        self._finish_all = finish_all or self._small
        self.build_time_s = self.nlp.build_time_s
        # Final postures of runs; the next runs continue from these postures with the extended program.
        self._ends: dict[int, Array] = {}
        # Penalty per meter of slack for starts without a trapped run.
        self._price = SLACK_PRICE
        # Number of trapped runs (:attr:`SolverRun.trapped`) of each start.
        self._trapped: Counter[int] = Counter()

    def run(self, jobs: int, progress: Progress | None) -> list[SolverRun]:
        """Run all starts; if the program lacks rows at a final posture, run again from this posture.

        The objective at such a final posture is a lower bound of the final objective of the start, because additional
        rows raise the objective.  Starts with the lowest bounds continue first.  Starts whose bounds are well above
        the objective of a certified posture do not continue.
        """
        runs: dict[int, SolverRun] = {}
        starts, best = self._draws.count, np.inf
        waiting, counts = list(range(starts)), [0] * starts
        # Results at which the program lacks rows, with the problem of their run.  Before the next run from the same
        # start, the missing rows are added to the program.
        owed: dict[int, tuple[SolveRecord, ConstrainedProblem]] = {}
        while waiting:
            batch = self._next(waiting, runs)
            self._grow([owed.pop(k) for k in batch if k in owed])
            groups = self._groups(batch)
            last = {k for group in groups.values() if max(counts[j] for j in group) >= _ROUNDS - 1 for k in group}
            for leader, run in self._round(list(groups), jobs, last):
                share = run.time_s / len(groups[leader])
                for k in groups[leader]:
                    runs[k] = replace(run, time_s=share + (runs[k].time_s if k in runs else 0.0))
                    counts[k] += 1
                if progress:
                    progress(min(len(runs), starts), starts)
                if run.good and run.minimized < best and self._clear(run):
                    best = run.minimized
            lacking = {k: r for k in batch if (r := runs[k].record) is not None and runs[k].lacks and k not in last}
            # A run with missing rows passes through bodies and may end between them.  With all rows and a higher
            # penalty on slack, a run stays within the constraints that its start satisfies.
            trapped = {k for k in batch if runs[k].trapped and k not in last}
            if len(runs) < starts and trapped == {*range(FIRST)}:
                # In the runs from all first starts, penetrating a body lowers the objective by more than the penalty
                # on the slack.
                self._price = HIGH_PRICE
            self._trapped.update(trapped)
            owed |= {k: (r, self.problem) for k, r in lacking.items()}
            ends = self._ends | {k: r.q for k, r in lacking.items()}
            self._ends = {k: q for k, q in ends.items() if k not in trapped}
            waiting = sorted({*waiting} - {*batch} | {*lacking, *trapped})
            if not self._finish_all:
                dominated = {k for k in waiting if k in runs and runs[k].minimized > best + _FAR * abs(best)}
                runs |= {k: replace(runs[k], dominated=True) for k in dominated}
                waiting = [k for k in waiting if k not in dominated]
        return [runs[index] for index in range(starts)]

    def _grow(self, owed: list[tuple[SolveRecord, ConstrainedProblem]]) -> None:
        """Add the rows that the program lacks at the given results; each result comes with its problem."""
        # The auxiliary unknowns of a result are valid only for the program that was solved.
        now = [record for record, problem in owed if problem is self.problem]
        before = [record.q for record, problem in owed if problem is not self.problem]
        numeric = self.nlp.program.numeric
        grown = self.problem.grown([r.q for r in now], numeric, [r.auxiliaries for r in now]).grown(before, numeric)
        if grown is not self.problem:
            self.problem, self.nlp = grown, self.nlp.grown(grown, compile=self._compile)
            self.build_time_s += self.nlp.build_time_s

    @property
    def _unknowns(self) -> int:
        return int(self.nlp.solver.size1_in("x0"))

    def _next(self, waiting: list[int], runs: dict[int, SolverRun]) -> list[int]:
        if not runs and self.problem.grows:
            # Run the first starts alone, because most other starts need the same additional rows.
            return waiting[:FIRST]
        if self._small and len(runs) == FIRST and waiting[0] < FIRST:
            # In a small program, the additional rows cost the other starts less time than a further run would take.
            return [k for k in waiting if k < FIRST]
        if self._finish_all or not all(k in runs for k in waiting):
            return waiting
        groups = self._groups(sorted(waiting, key=lambda k: runs[k].minimized))
        count = max(_BATCH // self._unknowns, _LEAST)
        return sorted(k for group in list(groups.values())[:count] for k in group)

    def _clear(self, run: SolverRun) -> bool:
        around = self.problem.surroundings
        return around is None or run.record is None or not around.collisions(run.record.q)

    def _groups(self, waiting: list[int]) -> dict[int, list[int]]:
        """Group starts that continue from the same posture; only the first start of a group runs."""
        groups: dict[int, list[int]] = {}
        for index in waiting:
            leader = index
            if index in self._ends:
                away = ((np.abs(self._ends[index] - self._ends[k]).max(), k) for k in groups if k in self._ends)
                leader = next((k for distance, k in away if distance < _SAME), index)
            groups.setdefault(leader, []).append(index)
        return groups

    def _round(self, waiting: list[int], jobs: int, last: set[int]) -> Iterator[tuple[int, SolverRun]]:
        jobs = jobs if len(waiting) * self._unknowns > _FORK else 1
        with fork_map(lambda k: self._timed(waiting[k], last=waiting[k] in last), len(waiting), jobs) as results:
            if around := self.problem.surroundings:
                # The final check needs the original shapes. Load the shapes now, because this process only waits for
                # the other processes.
                _ = around.shapes.geometry
            for k, run in results:
                yield waiting[k], run

    def _timed(self, index: int, *, last: bool) -> SolverRun:
        began = time.perf_counter()
        return replace(self._run(index, last=last), time_s=time.perf_counter() - began)

    @one_blas_thread()
    def _run(self, index: int, *, last: bool) -> SolverRun:
        """Run one start; if the program lacks rows at the result, certify the result in the last round only."""
        nlp, scale, problem = self.nlp, self._scale, self.problem
        numeric = nlp.program.numeric
        trapped, start = self._trapped[index], self._ends.get(index)
        if start is None:
            start = self._draws.choose(index, trapped)
        if start is None:
            return SolverRun()
        price = HIGH_PRICE * _DEARER ** (trapped - 1) if trapped else self._price
        try:
            record, certificate = nlp.solve(start, scale=scale, price=price), None
            lacks = record.converged and problem.grown([record.q], numeric, [record.auxiliaries]) is not problem
            if last or not lacks:
                record, certificate = run_start(nlp, start, scale, price, record)
            objective = problem.objective.value(record.q)
        except MetricError:
            # The objective is not defined at the final posture of the run.  The start then has no result, and the
            # other starts continue.
            return SolverRun(start)
        minimized = objective / scale
        if problem.requirements.regularization:
            minimized += problem.requirements.regularization * distance(nlp.chart, record.q, problem.given) ** 2
        certified = certificate is not None and certificate.holds()
        # If slack lowers the objective by more than the penalty, more rows do not help.
        pays = record.converged and problem.slack(record.auxiliaries) > FEASIBLE
        anew = record.converged and (pays or not lacks) and not certified and trapped < _ANEW
        anew = anew and not feasible(problem, record.q, numeric)
        return SolverRun(start, record, objective, minimized, certificate, lacks, trapped=anew)


def feasible(problem: ConstrainedProblem, q: Array, numeric: Numeric | None = None) -> bool:
    """Return whether ``q``, shape (nq,), satisfies all constraints, including those that the program lacks."""
    violations = problem.violations((numeric or Numeric(problem.robot.model)).at(q))
    return all(float(np.abs(excess).max(initial=0.0)) <= FEASIBLE for excess in violations)
