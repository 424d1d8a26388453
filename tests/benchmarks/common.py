"""Parts that the benchmarks share: problems, medians, and one Pinocchio ``crba`` as the machine's yardstick."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.impact.contact import Contact, Support
from impact_posture.impact.metric import Metric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.posture.problem import PostureProblem, Requirements, build_problem
from impact_posture.robot.loader import load_robot


def default_problem(name: str, frame: str, normal: tuple[float, float, float], **more: object) -> PostureProblem:
    """The problem that ``impact-posture optimize NAME --frame F --normal …`` solves."""
    robot = load_robot(name)
    supports = tuple(Support.from_spec(s) for s in robot.spec.supports)
    objective = ImpactObjective(robot, Contact.create(frame, normal), Metric(), "impulse", supports)
    spec = robot.spec.constraints
    asked: dict[str, object] = {
        "contact_pose": robot.contact_pose(frame),
        "base": "level" if spec.level_base else "free",
        "hold": spec.hold,
        "com_over_feet": spec.com_over_feet,
        "com_margin": spec.com_margin,
        "limit_margin": spec.limit_margin,
    }
    return build_problem(robot, objective, robot.posture(), Requirements(**(asked | more)))  # type: ignore[arg-type]


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
