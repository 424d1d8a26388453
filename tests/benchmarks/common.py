"""Parts that the benchmarks share: problems, medians, and one Pinocchio ``crba`` as the machine's yardstick."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.problem_settings import make_settings, prepare


def default_problem(
    name: str, frame: str | None, normal: tuple[float, float, float] | None, **more: object
) -> PostureProblem:
    """The problem that ``impact-posture optimize NAME --frame F --normal …`` solves."""
    return prepare(make_settings({"robot": name, "frame": frame, "normal": normal, **more})).problem


def median_time(call: Callable[[], object], repeats: int = 200) -> float:
    """Median wall time of a call, seconds."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def crba_time(model: pin.Model) -> float:
    """Median time of one Pinocchio ``crba`` from Python, seconds."""
    data = model.createData()
    q = pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq))
    return median_time(lambda: pin.crba(model, data, q), 2000)


def machine() -> str:
    """What this ran on and with."""
    return (
        f"Python {platform.python_version()}, CasADi {ca.__version__}, Pinocchio {pin.__version__}, "
        f"{platform.machine()}"
    )
