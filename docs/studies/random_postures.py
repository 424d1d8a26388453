"""How near random postures of a humanoid come to the optimum, and which share of the search evaluates postures."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

import impact_posture as ip
from docs.studies.cases import AHEAD, Case
from docs.studies.core import ROOT, Request, Vector, machine, table
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
# Number of postures of a batch, of best postures that are kept, of starts of IPOPT, and of seeds of the search.
_ROWS, _KEPT, _STARTS, _SEEDS = 65536, 1000, 16, 3
# Shares above the optimum within which postures are counted, and the share for the extrapolation.
_WITHIN = (0.01, 0.05, 0.1, 0.5, 1.0, 10.0)
_NEAR = _WITHIN[0]


class _Draws(NamedTuple):
    """Random postures: the objective of the best ones, and these postures; the first postures; counts.

    Attributes:
        values: Lowest objectives, increasing, shape (K,).
        q: Postures with these objectives, shape (K, nq).
        first: The first postures, shape (_STARTS, nq).
        median: Median of the objectives of the first batch.
        within: Number of postures within each share of ``_WITHIN`` above the optimum.
        time: Processor time, s; with a GPU, wall time.
    """

    values: Vector
    q: Vector
    first: Vector
    median: float
    within: list[int]
    time: float


def lines(request: Request) -> Iterator[str]:
    """Yield the page: random postures, and the share of evaluations in the search."""
    yield f"{machine()}; {request.count:.3g} random postures, evaluated on {'a GPU' if _gpu() else 'all cores'}."
    yield ""
    shares = [f"within {share:.0%}" if share < 1 else f"below {1 + share:g} times" for share in _WITHIN]
    head = (
        "joints",
        "optimum",
        "median",
        "best",
        *shares,
        f"extrapolated: one within {_NEAR:.0%} of",
        "processor s",
    )
    results = [(case, *_draws(case, request)) for case in _PROBLEMS if request.only in case.name]
    yield from table(head, [_row(case, best, draws, request.count) for case, _, best, draws in results])
    yield ""
    head = ("joints", "starts of IPOPT", f"ended within {_NEAR:.0%}", "best end")
    yield from table(
        head, (row for case, problem, best, draws in results for row in _ends(case, problem, best, draws))
    )
    yield ""
    yield from table(("robot", "search, processor s", "screening", "evaluations"), map(_shares, _SEARCHED))


def _gpu() -> Any:
    """Return CuPy if this machine has a GPU and CuPy can use it, else ``None``."""
    try:
        import cupy

        return cupy if cupy.cuda.runtime.getDeviceCount() else None
    except Exception:
        return None


def _draws(case: Case, request: Request) -> tuple[ConstrainedProblem, float, _Draws]:
    """Return the problem, the best objective of the default search, and the random postures."""
    problem = case.problem()
    best = min(_searched(problem, seed).optima[0].objective for seed in range(_SEEDS))
    out = ROOT / "build" / "random_postures" / case.name.replace(" ", "_")
    written = write_export([problem.objective], out, prefix="metric", cuda=_gpu() is not None, build=True, force=True)
    objective, model, xp = ip.gpu.load(written.out).objective, problem.robot.model, _gpu() or np
    moved = [
        k for k in range(1, model.njoints) if "leg_" not in model.names[k] and k != model.getJointId("root_joint")
    ]
    columns = [int(model.idx_qs[k]) for k in moved]
    low, high = (xp.asarray(limit[columns]) for limit in (model.lowerPositionLimit, model.upperPositionLimit))
    rng, q = xp.random.default_rng(request.seed), xp.asarray(np.tile(problem.given, (_ROWS, 1)))
    values, kept, within = np.zeros(0), np.zeros((0, problem.robot.nq)), np.zeros(len(_WITHIN), dtype=int)
    first, median, clock = kept, math.nan, time.perf_counter if _gpu() else time.process_time
    began = clock()
    for drawn in range(0, request.count, _ROWS):
        count = min(_ROWS, request.count - drawn)
        q[:, columns] = low + (high - low) * rng.random((_ROWS, len(columns)))
        value, _ = objective(q[:count])
        assert bool(xp.isfinite(value).all())
        within += [int((value <= best * (1 + share)).sum()) for share in _WITHIN]
        if not drawn:
            first, median = _host(q[:_STARTS]).copy(), float(xp.median(value))
        near = value < (values[-1] if len(values) == _KEPT else math.inf)
        values, kept = np.append(values, _host(value[near])), np.concatenate([kept, _host(q[:count][near])])
        order = np.argsort(values, kind="stable")[:_KEPT]
        values, kept = values[order], kept[order]
    return problem, best, _Draws(values, kept, first, median, within.tolist(), clock() - began)


def _host(array: Any) -> Any:
    return array.get() if hasattr(array, "get") else array


def _searched(problem: ConstrainedProblem, seed: int) -> PostureSolution:
    return solve(problem, seed=seed, jobs=1, screened=SCREENED)


def _row(case: Case, best: float, draws: _Draws, count: int) -> list[str]:
    # Extrapolate the share of postures with H < (1 + s) H* by a power law s^k.  Hill's estimator gives k of the best
    # postures (B. M. Hill, "A simple general approach to inference about the tail of a distribution", 1975).
    above = draws.values / best - 1
    power = len(above) / np.log(above[-1] / above).sum() if above[0] > 0 else math.nan
    needed = count / len(above) * (above[-1] / _NEAR) ** power
    return [
        case.name, f"{best:.4g}", f"{draws.median / best:.0f} times", f"{draws.values[0] / best:.2f} times",
        *(str(number) for number in draws.within), f"{needed:.0e} (k = {power:.1f})", f"{draws.time:.0f}",
    ]  # fmt: skip


def _ends(case: Case, problem: ConstrainedProblem, best: float, draws: _Draws) -> Iterator[list[str]]:
    for name, starts in ((f"the best {_STARTS}", draws.q[:_STARTS]), (f"the first {_STARTS}", draws.first)):
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
