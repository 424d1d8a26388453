"""How often the default search reaches the best known posture, and its time, compared with multi-start from 16
starts.

The cases are random serial arms whose contact point keeps its place, and all robots of the catalogue, above a floor
and in front of a wall.  The best known objectives are kept in the cache folder: each run can lower them.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from docs.studies.cases import BACK, DOWN, Case
from docs.studies.core import Request, machine, say, table
from impact_posture.config.problem_settings import SCREENED, STARTS
from impact_posture.errors import Infeasible
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import known_robots, load_robot
from impact_posture.robot.robot_spec import ContactSpec, RobotSpec
from impact_posture.system.libraries import cache_folder

# Number of random arms.
_ARMS = 76
# The constants of the search were chosen with the first arms up to this number, and not with the others.
_TUNED = 60
# Numbers of additional starts, which determine the best known objective of a case, and of a humanoid.
_MANY, _FEWER = 1024, 128
# Seed of these starts.
_OTHER_SEED = 1000
# The best known objective counts as reached if an objective is above it by at most this share.
_REACHED = 0.01
# Goals: share of runs that reach the best known objective, and median time divided by the time of 16 starts.
_SHARE, _TIMES = 0.95, {"random arms": 3.0, "arms": 3.0, "humanoids": 1.5}
_HEAD = (
    "cases", "runs", "reached by the default", "reached by 16 starts", "processor s", "16 starts, s",
    "median ratio", "goal",
)  # fmt: skip


class _Case(NamedTuple):
    name: str
    groups: tuple[str, ...]
    problem: ConstrainedProblem


class Run(NamedTuple):
    """Objective and processor time, s, of the default search and of multi-start in one run."""

    case: str
    groups: tuple[str, ...]
    seed: int
    objective: float
    time: float
    plain: float
    plain_time: float


def lines(request: Request) -> Iterator[str]:
    """Yield the page: a row for each group of cases, and the runs that missed the best known objective."""
    yield f"{machine()}; {request.count} seeds, one process."
    yield ""
    known = _Known()
    cases = chain(_arms(request.only), _catalogue(request.only))
    runs = [run for case in cases for run in _runs(case, request, known)]
    groups = dict.fromkeys(group for run in runs for group in run.groups)
    yield from table(_HEAD, (_row(group, [r for r in runs if group in r.groups], known, request) for group in groups))
    yield ""
    missed = [run for run in runs if known.above(run.case, run.objective) > _REACHED]
    share = 1 - len(missed) / max(len(runs), 1)
    if share < _SHARE:
        request.missed.append(f"{share:.1%} of the runs reached the best known objective")
    words = ", ".join(f"{r.case} with seed {r.seed} ({known.above(r.case, r.objective):.1%} above)" for r in missed)
    yield f"Runs of the default that missed: {len(missed)} of {len(runs)}. {words}".strip()


def _row(group: str, runs: list[Run], known: _Known, request: Request) -> list[str]:
    ratio, goal = statistics.median(run.time / run.plain_time for run in runs), _TIMES.get(group)
    if goal is not None and ratio > goal:
        request.missed.append(f"{group}: {ratio:.1f} times the time of {STARTS} starts")
    reached = sum(known.above(run.case, run.objective) <= _REACHED for run in runs) / len(runs)
    plain = sum(known.above(run.case, run.plain) <= _REACHED for run in runs) / len(runs)
    times = (statistics.median(run.time for run in runs), statistics.median(run.plain_time for run in runs))
    return [
        group, str(len(runs)), f"{reached:.1%}", f"{plain:.1%}",
        *(f"{middle:.2f}" for middle in times), f"{ratio:.1f}", "–" if goal is None else f"{goal:g}",
    ]  # fmt: skip


def _runs(case: _Case, request: Request, known: _Known) -> Iterator[Run]:
    name, groups, problem = case
    many = _FEWER if "humanoids" in groups else _MANY
    known.start(name, lambda: solve(problem, starts=many, seed=_OTHER_SEED, jobs=request.jobs, compile="never"))
    for seed in range(request.seed, request.seed + request.count):
        plain, plain_time = _timed(partial(solve, problem, seed=seed, jobs=1))
        better, took = _timed(partial(solve, problem, seed=seed, jobs=1, screened=SCREENED))
        known.lower(name, plain, better)
        say(f"{name}, seed {seed}: {better:.6g} in {took:.2f} s, {STARTS} starts {plain:.6g} in {plain_time:.2f} s")
        yield Run(name, groups, seed, better, took, plain, plain_time)


def _timed(run: Callable[[], PostureSolution]) -> tuple[float, float]:
    began = time.process_time()
    objective = run().optima[0].objective
    return objective, time.process_time() - began


def _arms(only: str) -> Iterator[_Case]:
    for number in range(_ARMS):
        if only in (name := f"arm {number}"):
            known = f"random arms 0–{_TUNED - 1}" if number < _TUNED else f"random arms {_TUNED}–{_ARMS - 1}"
            yield _Case(
                name, ("random arms", known, f"random arms with {_joints(number)} joints"), random_arm(number)
            )


def _catalogue(only: str) -> Iterator[_Case]:
    for robot in sorted(known_robots()):
        kind = load_robot(robot).spec.kind
        group = f"{kind}s" if kind in ("arm", "humanoid") else "others"
        for place, normal in (("floor", DOWN), ("wall", BACK)):
            if only in (name := f"{robot}, {place}"):
                problem = Case(name, robot, normal, {"collision": True, "holdable": True}).problem()
                try:
                    solve(problem, starts=1, jobs=1)
                except Infeasible:
                    continue
                yield _Case(name, ("catalogue", group), problem)


def _joints(number: int) -> int:
    return 6 + number % 4


def random_arm(number: int) -> ConstrainedProblem:
    """Build a problem: a serial arm of 6 to 9 hinges whose contact point keeps its place."""
    rng, count = np.random.default_rng([number, 45]), _joints(number)
    model, parent, place = pin.Model(), 0, np.zeros(3)
    for k in range(count):
        axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
        reach = rng.uniform(1.2, 3.0)
        bounds = [np.full(1, value) for value in (50.0, 10.0, -reach, reach)]
        turn = pin.exp3(rng.normal(size=3)) if rng.random() < 0.5 else np.eye(3)
        joint = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        parent = model.addJoint(parent, joint, pin.SE3(turn, place), f"joint_{k}", *bounds)
        rod = rng.normal(size=3)
        rod *= rng.uniform(0.1, 0.4) / np.linalg.norm(rod)
        mass = rng.uniform(0.2, 3.0)
        inertia = mass / 12 * (rod @ rod * np.eye(3) - np.outer(rod, rod)) + 1e-4 * np.eye(3)
        model.appendBodyToJoint(parent, pin.Inertia(mass, rod / 2, inertia), pin.SE3.Identity())
        place = rod
    model.addFrame(pin.Frame("tip", parent, 0, pin.SE3(np.eye(3), place), pin.FrameType.BODY))
    model.armature = np.full(count, 0.01)
    limits = zip(model.lowerPositionLimit, model.upperPositionLimit, strict=True)
    q = np.array([rng.uniform(0.6 * low, 0.6 * high) for low, high in limits])
    normal = rng.normal(size=3)
    spec = RobotSpec(kind="arm", contact=ContactSpec(frame="tip"))
    robot = Robot(f"arm {number}", "made up", model, "fixed", {"home": q}, "home", spec)
    objective = WorstCaseObjective(robot, ImpactContact("tip", tuple(normal / np.linalg.norm(normal))))
    return build_problem(robot, objective, q, Requirements(contact_pose="position"))


class _Known:
    """Best known objective of each case, in a file of the cache folder."""

    def __init__(self) -> None:
        self._path: Path = cache_folder("studies") / "best_known.json"
        self._best: dict[str, float] = json.loads(self._path.read_text()) if self._path.exists() else {}

    def start(self, case: str, search: Callable[[], PostureSolution]) -> None:
        """Search for a case that has no entry yet."""
        if case not in self._best:
            say(f"{case}: search for the best known objective")
            self.lower(case, search().optima[0].objective)

    def lower(self, case: str, *objectives: float) -> None:
        """Record objectives that are lower than the best known objective."""
        best = min(self._best.get(case, np.inf), *objectives)
        if best != self._best.get(case):
            self._best[case] = best
            self._path.write_text(json.dumps(self._best, indent=1) + "\n")

    def above(self, case: str, objective: float) -> float:
        """Return by which share an objective is above the best known objective."""
        return objective / self._best[case] - 1
