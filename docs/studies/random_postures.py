"""How near random postures of a humanoid come to the optimum, and which share of the search evaluates postures."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from docs.studies.cases import AHEAD, Case
from docs.studies.core import ROOT, Request, machine, table
from docs.studies.random_draws import STARTS, random_draws
from impact_posture.codegen.export import write_export
from impact_posture.config.problem_settings import SCREENED
from impact_posture.posture.manifold.batch_function import BatchFunction
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search import multistart
from impact_posture.posture.search.multistart import PostureSolution, solve

# Base and legs keep the given posture, and the contact may be anywhere, so all postures within the limits are
# feasible.
_STANCE = {"base": "fixed", "contact_pose": "free", "com": False}
_ARM = {"lock": ("arm_left_*", "gripper_*", "head_*")}
_PROBLEMS = (
    Case("torso and right arm", "talos", AHEAD, _STANCE | _ARM),
    Case("all joints above the legs", "talos", AHEAD, _STANCE),
)
_SEARCHED = ("panda", "xarm7", "solo12", "talos", "g1")
_SEEDS = 3
# Shares above the optimum within which postures are counted, and the share for the extrapolation.
_WITHIN = (0.01, 0.05, 0.1, 0.5, 1.0, 10.0)
_NEAR = _WITHIN[0]


def lines(request: Request) -> Iterator[str]:
    """Yield the page: random postures, and the share of evaluations in the search."""
    yield f"{machine()}; {request.count:.3g} random postures."
    yield ""
    shares = [f"within {share:.0%}" if share < 1 else f"below {1 + share:g} times" for share in _WITHIN]
    extrapolated = f"extrapolated: one within {_NEAR:.0%} of"
    head = ("joints", "optimum", "median", "best", *shares, extrapolated, "evaluated on, wall time")
    results = [(case, best, problem, random_draws(folder)) for case, best, problem, folder in _exports(request)]
    yield from table(head, [_row(case, best, draws, request.count) for case, best, _, draws in results])
    yield ""
    head = ("joints", "starts of IPOPT", f"ended within {_NEAR:.0%}", "best end")
    yield from table(
        head, (row for case, best, problem, draws in results for row in _ends(case, problem, best, draws))
    )
    yield ""
    yield from table(("robot", "search, processor s", "screening", "evaluations"), map(_shares, _SEARCHED))


def command(request: Request) -> Iterator[str]:
    """Write the exports and settings of the random postures; yield the command that draws them on any machine."""
    folders = (str(folder.relative_to(ROOT)) for *_, folder in _exports(request))
    yield f"python -m docs.studies.random_draws {' '.join(folders)}"


def _exports(request: Request) -> Iterator[tuple[Case, float, ConstrainedProblem, Path]]:
    """Yield each case, the best objective of the default search, the problem, and the folder for the draws."""
    for case in (case for case in _PROBLEMS if request.only in case.name):
        problem = case.problem()
        model, best = problem.robot.model, min(_searched(problem, seed).optima[0].objective for seed in range(_SEEDS))
        folder = ROOT / "build" / "random_postures" / case.name.replace(" ", "_")
        write_export([problem.objective], folder / "export", prefix="metric", cuda=True, build=True, force=True)
        # Joint 1 is the base.
        columns = [int(model.idx_qs[k]) for k in range(2, model.njoints) if "leg_" not in model.names[k]]
        limits = (limit[columns].tolist() for limit in (model.lowerPositionLimit, model.upperPositionLimit))
        counted = [best * (1 + share) for share in _WITHIN]
        settings = [problem.given.tolist(), columns, *limits, counted, request.count, request.seed]
        (folder / "settings.json").write_text(json.dumps(settings), encoding="utf-8")
        yield case, best, problem, folder


def _searched(problem: ConstrainedProblem, seed: int) -> PostureSolution:
    return solve(problem, seed=seed, jobs=1, screened=SCREENED)


def _row(case: Case, best: float, draws: dict[str, Any], count: int) -> list[str]:
    # Extrapolate the share of postures with H < (1 + s) H* by a power law s^k.  Hill's estimator gives k of the best
    # postures (B. M. Hill, "A simple general approach to inference about the tail of a distribution", 1975).
    above = draws["values"] / best - 1
    power = len(above) / np.log(above[-1] / above).sum() if above[0] > 0 else math.nan
    needed = count / len(above) * (above[-1] / _NEAR) ** power
    return [
        case.name, f"{best:.4g}", f"{draws['median'] / best:.0f} times", f"{draws['values'][0] / best:.2f} times",
        *(str(number) for number in draws["within"]), f"{needed:.0e} (k = {power:.1f})",
        f"{draws['device']}, {draws['time']:.0f} s",
    ]  # fmt: skip


def _ends(case: Case, problem: ConstrainedProblem, best: float, draws: dict[str, Any]) -> Iterator[list[str]]:
    for name, starts in ((f"the best {STARTS}", draws["q"][:STARTS]), (f"the first {STARTS}", draws["first"])):
        optima = solve(problem, starts=len(starts), guesses=[*starts], jobs=1, finish_all=True).optima
        near = sum(o.hits for o in optima if o.objective <= best * (1 + _NEAR))
        yield [
            case.name,
            f"{name} and the given posture",
            str(near),
            f"{round(optima[0].objective / best - 1, 4) + 0.0:+.2%}",
        ]


def _shares(robot: str) -> list[str]:
    """Run the default search; return its processor time and the shares of its screening and of batch functions."""
    problem = Case(robot, robot, AHEAD).problem()
    with _timed(multistart, "screen") as screening, _timed(BatchFunction, "__call__") as evaluations:
        began = time.process_time()
        for seed in range(_SEEDS):
            _searched(problem, seed)
        took = time.process_time() - began
    return [robot, f"{took / _SEEDS:.2f}", *(f"{sum(times) / took:.0%}" for times in (screening, evaluations))]


@contextmanager
def _timed(owner: Any, name: str) -> Iterator[list[float]]:
    """Append the processor time of each call of a function to the list."""
    call, times = getattr(owner, name), list[float]()

    def timed(*arguments: Any, **options: Any) -> Any:
        began = time.process_time()
        try:
            return call(*arguments, **options)
        finally:
            times.append(time.process_time() - began)

    with patch.object(owner, name, timed):
        yield times
