"""Attainable approach speed at the optimum, and how much a required approach speed increases the objective."""

from __future__ import annotations

from collections.abc import Iterator

from docs.studies.cases import BACK, DOWN
from docs.studies.core import Request, machine, say, table
from docs.studies.feasible import STARTS, solved
from impact_posture.posture.approach.attainable_speed import AttainableSpeed
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.robot.robot_loader import known_robots
from tests.support.settings import make_settings

_HEAD = ("robot", "normal", "start, m/s", "optimum, m/s", "asked, m/s", "loss", "certified", "a start")
_SHARE = 0.9


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each normal and each robot whose joints move the contact to the surface."""
    yield f"Fastest approach speed at the start and in the best optimum of {STARTS} starts, with constraints on"
    yield f"collisions and motor limits. Last columns: the optimum if {_SHARE:.0%} of the start speed is required."
    yield "*loss*: increase of the objective by this requirement. *a start*: median time of a start, divided by"
    yield "the median without the requirement. Flying robots and contacts on the trunk have no speed limit."
    yield "Robots without a collision-free posture have no row."
    yield machine()
    yield ""
    cases = [(robot, normal) for robot in known_robots() if request.only in robot for normal in (DOWN, BACK)]
    yield from table(_HEAD, (row for case in cases if (row := _row(*case, request.seed))))


def _row(robot: str, normal: tuple[float, float, float], seed: int) -> list[str]:
    say(f"{robot} {normal}")
    asked = {"robot": robot, "normal": normal, "collision": True, "holdable": True, "seed": seed}
    problem = prepare(make_settings(asked)).problem
    attainable = AttainableSpeed(problem.robot, problem.objective, problem.requirements)
    if attainable.unknown:
        return []
    solution, (apart, _) = solved(asked)
    if not isinstance(solution, PostureSolution):
        return []
    start, optimum = (attainable.reached(q) for q in (solution.initial, solution.q))
    cells = [robot, "down" if normal == DOWN else "ahead", _digits(start), _digits(optimum)]
    if not start:
        return [*cells, *["–"] * 4]
    speed = float(f"{_SHARE * start:.2g}")
    again, (took, _) = solved(asked | {"approach": True, "speed": speed})
    assert isinstance(again, PostureSolution), again
    loss = again.optima[0].objective / solution.optima[0].objective - 1
    return [*cells, f"{speed:g}", f"{100 * loss:.1f} %", f"{again.certified_starts}", f"{took / apart:.1f}×"]


def _digits(speed: float | None) -> str:
    return "unbounded" if speed is None else f"{speed:.2g}"
