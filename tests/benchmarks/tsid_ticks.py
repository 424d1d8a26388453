"""What a tick of the online controllers takes of one core, along a moving reference.

Run: python -m tests.benchmarks.tsid_ticks [--robot NAME] [--ticks 2000] [--write]
"""

# ruff: noqa: E402 - threads are counted when numpy is loaded

from __future__ import annotations

import argparse
import os

# Before numpy is loaded: one core means one thread.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import gc
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.benchmark.timing import one_core
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.tsid.body_tasks import CenterOfMass
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.frame_tasks import FramePose
from impact_posture.tsid.impact_robust import Gradient, ImpactRobustPosture, gradient_of
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.qp import Solved, Solver
from impact_posture.tsid.qpsolvers_solver import QpsolversSolver
from impact_posture.tsid.task_formulation import aerial_formulation, legged_formulation
from tests.benchmarks.common import crba_time, default_problem, machine

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "tsid.md"
DT = 1e-3
# The most that the impact-robust controller may take of the nominal one's tick.
RATIO = 1.05


@dataclass(frozen=True)
class Case:
    """A robot, the impact that it braces for, its reference, and the most that a tick may take, µs."""

    robot: str
    frame: str
    normal: tuple[float, float, float]
    amplitude: tuple[float, float, float]
    median: float
    p99: float


CASES = [
    Case("tilthex_arm", "ee", (0.0, 0.0, 1.0), (0.05, 0.02, 0.05), 120, 300),
    Case("solo8", "base_link", (1.0, 0.0, 0.0), (0.01, 0.0, 0.01), 180, 450),
    Case("talos", "torso_2_link", (1.0, 0.0, 0.0), (0.01, 0.02, 0.01), 240, 600),
]


class Reference:
    """A sine, with its velocity and acceleration, that a task follows."""

    def __init__(self, task: FramePose | CenterOfMass, amplitude: Sequence[float]) -> None:
        self.task, self.amplitude, self.rate = task, np.array(amplitude), 2 * np.pi * np.array([0.5, 0.4, 0.3])
        target = task.target
        self.home = np.array(target.translation if isinstance(task, FramePose) else target)

    def move(self, t: float) -> None:
        """Set the task's target at ``t``."""
        task, rate = self.task, self.rate
        position = self.home + self.amplitude * np.sin(rate * t)
        if isinstance(task, FramePose):
            task.target = pin.SE3(task.target.rotation, position)
        else:
            task.target = position
        task.target_velocity[:3] = self.amplitude * rate * np.cos(rate * t)
        task.target_acceleration[:3] = -self.amplitude * rate**2 * np.sin(rate * t)


class Timed:
    """A solver that notes what it takes, and keeps some of the programs."""

    def __init__(self, inner: Solver) -> None:
        self.inner, self.times, self.kept = inner, [], []

    def reset(self) -> None:
        self.inner.reset()

    @property
    def infeasible(self) -> bool:
        return self.inner.infeasible

    def solve(self, qp) -> Solved | None:
        began = time.thread_time_ns()
        solved = self.inner.solve(qp)
        self.times.append(time.thread_time_ns() - began)
        if len(self.times) % 10 == 0:
            self.kept.append((qp.copy(), solved))
        return solved


class Flight:
    """One controller on its robot, moved by what it plans."""

    def __init__(self, case: Case, robot: Robot, posture: JointPosture) -> None:
        aerial = robot.spec.kind == "aerial"
        formulation = aerial_formulation(robot, posture) if aerial else legged_formulation(robot, posture)
        self.controller, self.posture, self.robot = Controller(robot, formulation), posture, robot
        self.q, self.v = robot.posture(), np.zeros(robot.nv)
        self.controller.reset(self.q, self.v)
        leading = formulation.levels[1][0] if aerial else formulation.weighted[0]
        assert isinstance(leading, FramePose | CenterOfMass)
        self.reference = Reference(leading, case.amplitude)
        self.took: list[int] = []
        self.wall: list[int] = []
        self.relaxed = 0
        if isinstance(posture, ImpactRobustPosture):
            posture.brace()

    def tick(self, k: int) -> None:
        self.reference.move(k * DT)
        began, cpu = time.perf_counter_ns(), time.thread_time_ns()
        command = self.controller.tick(k * DT, self.q, self.v)
        self.took.append(time.thread_time_ns() - cpu)
        self.wall.append(time.perf_counter_ns() - began)
        if command.status not in (Status.SOLVED, Status.RELAXED):
            raise SystemExit(f"{self.robot.name}, tick {k}: {command.status}")
        self.relaxed += command.status is Status.RELAXED
        self.v = self.v + DT * command.acceleration
        self.q = np.asarray(pin.integrate(self.robot.model, self.q, DT * self.v))


def postures(robot: Robot, gradient: Gradient, every: int = 5) -> tuple[JointPosture, ImpactRobustPosture]:
    """Nominal and impact-robust, with the same gains but for the term."""
    if robot.spec.kind == "aerial":
        return JointPosture(robot), ImpactRobustPosture(robot, gradient, K=10.0, every=every)
    more = {"kp": 20.0, "weight": 0.1, "base_weight": 0.0}
    return JointPosture(robot, **more), ImpactRobustPosture(robot, gradient, K=20.0, every=every, **more)


def run(case: Case, ticks: int) -> tuple[list[str], list[str], bool]:
    """Rows of the two tables, and whether the limits were kept."""
    robot = load_robot(case.robot)
    with tempfile.TemporaryDirectory() as folder:
        export(default_problem(case.robot, case.frame, case.normal).objective, Path(folder), check=False)
        gradient = gradient_of(ImpactGradient.load(folder, robot=robot))
        crba = crba_time(robot.model) * 1e6
        nominal, robust = (Flight(case, robot, posture) for posture in postures(robot, gradient))
        often = Flight(case, robot, postures(robot, gradient, every=1)[1])
        gc.collect()
        for k in range(ticks):
            # In turn, so that all meet the same disturbances of the machine.
            for flight in (nominal, robust, often):
                flight.tick(k)
        timed = Flight(case, robot, postures(robot, gradient)[1])
        clock = Timed(timed.controller._solver)
        timed.controller._solver = clock
        for k in range(min(ticks, 500)):
            timed.tick(k)
    middle = {f: float(np.median(f.took)) / 1e3 for f in (nominal, robust, often)}
    late = float(np.percentile(robust.took, 99)) / 1e3
    wall = [float(x) / 1e3 for x in (np.median(robust.wall), np.percentile(robust.wall, 99))]
    good = middle[robust] <= case.median and late <= case.p99 and middle[robust] <= RATIO * middle[nominal]
    ticks_row = (
        f"| {case.robot} | {middle[robust]:.0f} | {late:.0f} | {case.median:.0f}, {case.p99:.0f} | "
        f"{wall[0]:.0f} | {wall[1]:.0f} | {middle[robust] / crba:.0f} | "
        f"{middle[robust] / middle[nominal]:.3f}, {usual(robust) / usual(nominal):.3f} "
        f"({middle[often] / middle[nominal]:.3f}, {usual(often) / usual(nominal):.3f}) | {robust.relaxed} |"
    )
    qp = timed.controller.assembly.qp
    others = [other(name, clock.kept) for name in ("proxqp", "quadprog")]
    solver_row = f"| {case.robot} | {qp.n} | {qp.m} | {np.median(clock.times) / 1e3:.0f} | {' | '.join(others)} |"
    return [ticks_row], [solver_row], good


def usual(flight: Flight) -> float:
    """Mean of the shorter 99 % of a flight's ticks, µs: what the machine does beside is left out."""
    took = np.sort(flight.took)
    return float(took[: int(0.99 * took.size)].mean()) / 1e3


def other(name: str, programs: Sequence[tuple]) -> str:
    """Median time of another solver on the same programs, with its largest difference from ours; or a dash."""
    settings = {"eps_abs": 1e-9} if name == "proxqp" else {}
    try:
        solver = QpsolversSolver(name, **settings)
    except InputError:
        return "–"
    times, apart = [], 0.0
    for qp, solved in programs:
        began = time.thread_time_ns()
        answer = solver.solve(qp)
        times.append(time.thread_time_ns() - began)
        if answer is None or solved is None:
            return "failed"
        apart = max(apart, float(np.abs(answer.z - solved.z).max() / np.abs(solved.z).max()))
    return f"{np.median(times) / 1e3:.0f} ({apart:.0e})"


def main() -> int:
    """Print the tables; with ``--write`` also leave them for the documentation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", choices=[case.robot for case in CASES], help="this one only")
    parser.add_argument("--ticks", type=int, default=2000)
    parser.add_argument("--write", action="store_true", help=f"also write {PAGE.name} of the documentation")
    args = parser.parse_args()
    if args.write and args.robot:
        parser.error("--write is for all robots together: leave --robot away")
    ticks, solvers, good = [], [], True
    with one_core():
        for case in CASES:
            if args.robot in (None, case.robot):
                more, others, kept = run(case, args.ticks)
                ticks, solvers, good = ticks + more, solvers + others, good and kept
    page = "\n".join(
        [
            f"{machine()}, NumPy {np.__version__}, DAQP {version('daqp')}",
            "",
            f"{args.ticks} ticks, one core; impact-robust controller, bracing. Processor time of a tick, µs; wall",
            "time includes what else the machine did. Robust over nominal: of medians, of means of the shorter 99 %;",
            "the gradient sampled every fifth tick (in brackets: every tick).",
            "",
            "| robot | median | p99 | goals | wall median | wall p99 | median / crba | robust / nominal | relaxed |",
            "|---|---|---|---|---|---|---|---|---|",
            *ticks,
            "",
            "The QP of a tick, median µs; in brackets the largest relative difference from DAQP's solution:",
            "",
            "| robot | variables | rows | DAQP, warm | ProxQP, cold | quadprog, cold |",
            "|---|---|---|---|---|---|",
            *solvers,
            "",
        ]
    )
    print(page)
    if args.write:
        header = "<!-- Written by `python -m tests.benchmarks.tsid_ticks --write`; do not edit. -->\n\n"
        PAGE.write_text(header + page, encoding="utf-8")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
