"""Effect of constraints on the optimum: without constraints, without collisions, and with holdable postures."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from docs.studies.cases import BACK, DOWN
from docs.studies.core import Request, machine, say, table
from impact_posture.errors import ImpactPostureError
from impact_posture.posture.constraints.surroundings import Surroundings
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.robot.robot_loader import known_robots
from tests.support.settings import make_settings

_HEAD = ("robot", "normal", "free: objective", "certified", "collide", "ms", "clear: loss", "certified", "a start",
         "search", "all: loss", "certified", "left out", "a start", "search", "left", "above", "time")  # fmt: skip
_NORMALS = {"down": DOWN, "ahead": BACK}
STARTS = 16


class Cost(NamedTuple):
    """Results of searches under constraints, with several seeds.

    Attributes:
        solutions: Solution of the search with each seed.
        start: Median time of a start, divided by its value in an unconstrained search just before; median over the
            seeds.
        search: Time of the whole search, divided by the time of the unconstrained search; median over the seeds.
        took: Time of the search with the first seed, s.
    """

    solutions: tuple[PostureSolution, ...]
    start: float
    search: float
    took: float

    @property
    def certified(self) -> str:
        """Smallest number of certified solutions over the seeds."""
        return f"{min(solution.certified_starts for solution in self.solutions)}"


def lines(request: Request) -> Iterator[str]:
    yield "Each robot of the catalogue hits a floor (*down*) and a wall (*ahead*) with its contact frame. Each"
    yield f"search has {STARTS} starts. *free*: no constraints on collisions and motors. *clear*: no collisions."
    yield "*all*: no collisions, and the motors can hold the posture. *collide*: number of distinct optima of"
    yield "the free problem at which collision shapes touch each other, the surface or the ground. *loss*:"
    yield "increase of the objective of the best posture. *left out*: number of certified solutions that the"
    yield "check of the original shapes rejected. *ms*: median time of a start. *a start*: *ms* divided by"
    yield "the *ms* of the preceding free search. *search*: the same ratio for the time of the whole"
    yield f"search, which repeats some starts. Both ratios are medians over {request.count} seeds. *certified* is"
    yield "the smallest number over the seeds, *left out* is the sum. All of these searches finish every start."
    yield "The default stops starts that can no longer become the best. *left*: number of stopped starts."
    yield "*above*: increase of the best objective by stopping them. *time*: time of the default search, divided"
    yield "by the time with all starts. A dash: no posture satisfies the constraints, and the last column names"
    yield "the conflict."
    yield machine()
    yield ""
    ends, left = list[int](), list[int]()
    cases = [(robot, name) for robot in known_robots() if request.only in robot for name in _NORMALS]
    yield from table((*_HEAD, "conflict"), (_row(robot, name, request, ends, left) for robot, name in cases))
    yield ""
    yield f"Certified solutions, all constraints, from {request.count} seeds: {sum(ends)}.  At {sum(left)} of them,"
    yield "original shapes touch, and these solutions were left out."


def _row(robot: str, name: str, request: Request, ends: list[int], left: list[int]) -> list[str]:
    say(f"{robot} {name}")
    asked = {"robot": robot, "normal": _NORMALS[name], "seed": request.seed}
    clear: dict[str, object] = {"collision": True}
    everything = clear | {"holdable": True}
    free, apart = solved(asked)
    around = _surroundings(asked | clear)
    if not isinstance(free, PostureSolution):
        return [robot, name, *["–"] * (len(_HEAD) - 2), free]
    collide = sum(bool(around.collisions(optimum.q)) for optimum in free.optima)
    best = free.optima[0].objective
    cells = [
        robot,
        name,
        f"{best:.4g}",
        f"{free.certified_starts}",
        f"{collide} of {len(free.optima)}",
        f"{1e3 * apart[0]:.0f}",
    ]
    conflict = ""
    for demands in (clear, everything):
        cost = _cost(asked, demands, range(request.seed, request.seed + request.count))
        if isinstance(cost, str):
            cells += ["–"] * (4 if demands is clear else 8)
            conflict = cost
            continue
        first = cost.solutions[0].optima[0].objective
        cells += [f"{100 * (first / best - 1):.1f} %", cost.certified]
        if demands is everything:
            touching = [solution.colliding_starts for solution in cost.solutions]
            cells.append(f"{sum(touching)}")
            ends += [solution.certified_starts + solution.colliding_starts for solution in cost.solutions]
            left += touching
        cells += [f"{cost.start:.1f}×", f"{cost.search:.1f}×"]
        if demands is everything:
            quick, less = solved(asked | demands, finish_all=False)
            assert isinstance(quick, PostureSolution)
            above = quick.optima[0].objective / first - 1
            dominated = quick.dominated_starts
            share = f"{100 * less[1] / cost.took:.0f} %"
            cells += [f"{dominated}", f"{100 * above:.1f} %", share] if dominated else ["0", "", ""]
    return [*cells, conflict]


def _cost(asked: dict[str, object], demands: dict[str, object], seeds: Sequence[int]) -> Cost | str:
    """Search under constraints with several seeds; return an error text if a search fails."""
    solutions, starts, searches, times = list[PostureSolution](), list[float](), list[float](), list[float]()
    for seed in seeds:
        # Each ratio has its own unconstrained search, because other programs change the speed of the machine.
        apart = solved(asked | {"seed": seed})[1]
        solution, took = solved(asked | demands | {"seed": seed})
        if not isinstance(solution, PostureSolution):
            return solution
        solutions.append(solution)
        starts.append(took[0] / apart[0])
        searches.append(took[1] / apart[1])
        times.append(took[1])
    return Cost(tuple(solutions), statistics.median(starts), statistics.median(searches), times[0])


def solved(asked: dict[str, object], finish_all: bool = True) -> tuple[PostureSolution | str, tuple[float, float]]:
    """Return the solution or an error text, the median time of a start, and the time of the search, s."""
    try:
        problem = prepare(make_settings(asked)).problem
        began = time.perf_counter()
        seed = int(str(asked["seed"]))
        solution = solve(problem, starts=STARTS, seed=seed, jobs=1, compile="never", finish_all=finish_all)
        return solution, (solution.start_time_s, time.perf_counter() - began)
    except ImpactPostureError as error:
        return error.what, (0.0, 0.0)


def _surroundings(asked: dict[str, object]) -> Surroundings:
    around = prepare(make_settings(asked)).problem.surroundings
    assert around is not None
    return around
