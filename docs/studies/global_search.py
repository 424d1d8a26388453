"""Evaluate the global search: bounds for small redundancy, and basin hopping compared with multi-start."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator

import numpy as np

from docs.studies.cases import AHEAD, ASIDE, DOWN, Case
from docs.studies.core import Request, machine, say, table
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.feasible_start import feasible_start
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
    # Leave out borinot with an impact ahead, because it then has three degrees of freedom.
    if (robot, name) != ("borinot", "ahead")
]
_HOPPED = [
    Case("g1", "g1", AHEAD),
    Case("anymal_kinova", "anymal_kinova", AHEAD),
    Case("hextilt", "hextilt", AHEAD),
    Case("talos, aside", "talos", ASIDE),
]
_MAP = "case|degrees of freedom|components|objective|gap|word|patches|processor s|starts that missed it|runs that did"
_Search = Callable[[ConstrainedProblem, int, float, float], tuple[PostureSolution, int]]
_HOP = (
    "case|processor s|multi-start: starts|above the best, %|screened: postures|above, %|hops|above, %|best of all|"
    "hops better : worse than multi-start"
)


def maps(request: Request) -> Iterator[str]:
    """Yield the page about bounds of the objective.  Its table has a row for each case."""
    yield from _machine(request)
    yield from table(_MAP.split("|"), _maps(request))


def hops(request: Request) -> Iterator[str]:
    """Yield the page that compares searches with equal time.  Its table has a row for each case."""
    yield from _machine(request)
    yield from table(_HOP.split("|"), _searches(request))


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


def _searches(request: Request) -> Iterator[list[str]]:
    for case in (case for case in _HOPPED if request.only in case.name):
        problem = case.problem()
        runs_by_search: dict[str, list[tuple[float, float, int]]] = {"multi": [], "screened": [], "hops": []}
        for seed in range(request.count):
            began = time.process_time()
            first = _run(problem, seed)
            start_s = (time.process_time() - began) / _STARTS
            hopped = search_globally(first, seed=seed, jobs=1, compile="never")
            budget = time.process_time() - began
            best = hopped.solution.problem.objective.value(hopped.solution.q)
            runs_by_search["hops"].append((best, budget, hopped.search.hops))
            arguments = problem, seed, budget, start_s
            runs_by_search["multi"].append(_timed(_many, arguments))
            runs_by_search["screened"].append(_timed(_screened, arguments))
            say(f"{case.name}, seed {seed}: " + ", ".join(f"{k} {v[-1][0]:.5g}" for k, v in runs_by_search.items()))
        best = min(value for runs in runs_by_search.values() for value, _, _ in runs)
        medians = {
            key: [statistics.median(part) for part in zip(*runs, strict=True)] for key, runs in runs_by_search.items()
        }
        pairs = zip(runs_by_search["hops"], runs_by_search["multi"], strict=True)
        ratios = [hops[0] / multi[0] for hops, multi in pairs]
        won, lost = sum(r < 1 - _MISSED for r in ratios), sum(r > 1 + _MISSED for r in ratios)
        if lost > won:
            request.missed.append(f"{case.name}: basin hopping lost {lost} times and won {won}")
        times = " / ".join(f"{middle[1]:.1f}" for middle in medians.values())
        cells = [
            text
            for value, _, count in medians.values()
            for text in (f"{count:.0f}", f"{100 * (value / best - 1):.2f}")
        ]
        yield [case.name, times, *cells, f"{best:.5g}", f"{won} : {lost}"]


def _run(problem: ConstrainedProblem, seed: int, starts: int = _STARTS, finish_all: bool = False) -> PostureSolution:
    return solve(problem, starts=starts, seed=seed, jobs=1, compile="never", finish_all=finish_all)


def _timed(search: _Search, arguments: tuple[ConstrainedProblem, int, float, float]) -> tuple[float, float, int]:
    """Run a search; return its objective, its processor time, s, and the number of its starts."""
    began = time.process_time()
    solution, count = search(*arguments)
    return solution.problem.objective.value(solution.q), time.process_time() - began, count


def _many(problem: ConstrainedProblem, seed: int, budget: float, start_s: float) -> tuple[PostureSolution, int]:
    """Solve from as many independent starts as the time budget allows."""
    count = max(1, round(budget / start_s))
    return _run(problem, seed, count), count


def _screened(problem: ConstrainedProblem, seed: int, budget: float, start_s: float) -> tuple[PostureSolution, int]:
    """Draw feasible postures for half of the time, then solve from the best postures that are far from each other."""
    began, rng, kept, tried = time.process_time(), np.random.default_rng([seed, 2]), [], 0
    while time.process_time() - began < budget / 2:
        start = feasible_start(problem, len(kept) + tried, seed + 1000)
        tried += start is None
        kept += [] if start is None else [start]
    manifold = ConstraintManifold(problem)
    x = np.array([manifold.chart.to_x(q) for q in kept])
    points, order = manifold.embed(x), np.argsort(manifold.objective(x)[0])
    apart = np.median(np.linalg.norm(points - points[rng.permutation(len(points))], axis=1)) / 2
    chosen: list[int] = []
    for k in order:
        if not chosen or np.linalg.norm(points[chosen] - points[k], axis=1).min() > apart:
            chosen.append(int(k))
    count = max(1, round((began + budget - time.process_time()) / start_s))
    guesses = [manifold.to_q(x[k]) for k in chosen[:count]]
    return solve(problem, starts=1 + len(guesses), seed=seed, jobs=1, compile="never", guesses=guesses), len(x)
