"""Evaluate the global search: bounds for small redundancy, and basin hopping compared with multi-start."""

from __future__ import annotations

import time
from collections.abc import Iterator

from docs.studies.cases import AHEAD, DOWN, Case
from docs.studies.core import Request, machine, table
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.global_search import search_globally
from impact_posture.posture.search.multistart import PostureSolution, solve

_STARTS = 16
# A run missed the best posture if its objective is more than this share above the best objective.
_MISSED = 1e-3
# Robots for which the goal is a gap of 1 % within a minute.
_GOALS = ("tilthex_arm", "panda", "ur5", "xarm7")
_MAPPED = [
    Case(f"{robot}, {name}", robot, normal)
    for robot in (*_GOALS, "z1", "kinova", "tiago", "borinot")
    for name, normal in (("down", DOWN), ("ahead", AHEAD))
    # Leave out borinot in front of a wall, because its constraints then leave three degrees of freedom.
    if (robot, name) != ("borinot", "ahead")
]
_MAP = "case|degrees of freedom|components|objective|gap|word|patches|processor s|starts that missed it|runs that did"


def maps(request: Request) -> Iterator[str]:
    """Yield the page about bounds of the objective.  The table of this page has a row for each case."""
    yield from _machine(request)
    yield from table(_MAP.split("|"), _maps(request))


def _machine(request: Request) -> Iterator[str]:
    yield f"{machine()}; {request.count} seeds, {_STARTS} starts a run, one process."
    yield ""


def _maps(request: Request) -> Iterator[list[str]]:
    for case in (case for case in _MAPPED if request.only in case.name):
        problem = case.problem()
        runs = [_run(problem, seed, finish_all=True) for seed in range(request.count)]
        began = time.process_time()
        mapped = search_globally(runs[0], jobs=1, compile="never")
        took = time.process_time() - began
        assert mapped.search.bound is not None and mapped.search.motion is not None
        best = mapped.search.bound.best
        hits = [(o.objective <= best * (1 + _MISSED), o.hits) for run in runs for o in run.optima]
        missed = sum(count for near, count in hits if not near) / sum(count for _, count in hits)
        failed = sum(run.optima[0].objective > best * (1 + _MISSED) for run in runs)
        if case.robot in _GOALS and (took > 60 or mapped.search.bound.gap > 0.01):
            request.missed.append(f"{case.name}: gap {mapped.search.bound.gap:.3f} in {took:.0f} s")
        yield [
            case.name, str(mapped.search.redundancy), str(len(mapped.search.motion.components)), f"{best:.5g}",
            f"{100 * mapped.search.bound.gap:.2g} %", str(mapped.search.word), str(mapped.search.bound.patches),
            f"{took:.1f}", f"{100 * missed:.0f} %", f"{failed} of {len(runs)}",
        ]  # fmt: skip


def _run(problem: ConstrainedProblem, seed: int, starts: int = _STARTS, finish_all: bool = False) -> PostureSolution:
    return solve(problem, starts=starts, seed=seed, jobs=1, compile="never", finish_all=finish_all)
