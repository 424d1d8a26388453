"""Processor time of a tick of the online controllers on one core, while they track a moving reference."""

from __future__ import annotations

import gc
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
import qpsolvers

from docs.studies.cases import CASES
from docs.studies.core import Request, Vector, crba_time, machine, one_core, table
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.robot.robot import Robot
from impact_posture.tsid.controller import Controller, Status
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.qp.daqp_solver import DaqpSolver
from impact_posture.tsid.qp.quadratic_program import QP, Solved
from impact_posture.tsid.task_formulation import aerial_formulation, legged_formulation
from impact_posture.tsid.tasks.body_tasks import CenterOfMass
from impact_posture.tsid.tasks.frame_tasks import FramePose
from impact_posture.tsid.tasks.impact_robust import Gradient, ImpactRobustPosture, gradient_of
from impact_posture.tsid.tasks.joint_posture import JointPosture
from tests.support.qpsolvers_solver import QpsolversSolver

DT = 1e-3
# Goal for the time of an impact-robust tick divided by the time of a nominal tick.
RATIO = 1.05
# Goal for the mean time of a tick with a reference flow, divided by the time of a nominal tick.  The mean is used,
# because updates of the flow are spread over several ticks.
FLOW_RATIO = 2.0
_OTHERS = {"proxqp": {"eps_abs": 1e-9}, "quadprog": {}}
_TICKS = (
    "robot|median|p99|goals|wall median|wall p99|median / crba|robust / nominal|flow / nominal|flow p99|relaxed"
).split("|")


# Amplitude of the reference, m, and goals for the time of a tick, µs: median, 99th percentile.
GOALS = {
    "tilthex_arm": ((0.05, 0.02, 0.05), 120, 300),
    "solo8, four feet": ((0.01, 0.0, 0.01), 180, 450),
    "talos at the torso": ((0.01, 0.02, 0.01), 240, 600),
}


class Timed:
    """QP solver that records the time of each solve, µs, and stores every tenth program."""

    def __init__(self, inner: DaqpSolver) -> None:
        self.inner, self.times, self.kept = inner, list[float](), list[tuple[QP, Solved | None]]()
        self.reset = inner.reset

    @property
    def infeasible(self) -> bool:
        return self.inner.infeasible

    def solve(self, qp: QP) -> Solved | None:
        began = time.thread_time_ns()
        solved = self.inner.solve(qp)
        self.times.append((time.thread_time_ns() - began) / 1e3)
        if len(self.times) % 10 == 0:
            self.kept.append((qp.copy(), solved))
        return solved


class Flight:
    """Controller of a robot that moves exactly as planned and tracks a sine reference."""

    def __init__(self, amplitude: Sequence[float], robot: Robot, posture: JointPosture) -> None:
        aerial = robot.spec.kind == "aerial"
        program = aerial_formulation(robot, posture) if aerial else legged_formulation(robot, posture)
        self.controller, self.robot = Controller(robot, program), robot
        self.q, self.v = robot.posture(), np.zeros(robot.nv)
        self.controller.reset(self.q, self.v)
        self.task = program.levels[1][0] if aerial else program.weighted[0]
        assert isinstance(self.task, FramePose | CenterOfMass)
        target = self.task.target
        self.home = np.array(target.translation if isinstance(self.task, FramePose) else target)
        self.amplitude, self.rate = np.array(amplitude), 2 * np.pi * np.array([0.5, 0.4, 0.3])
        # Processor time and wall time of each tick, µs.
        self.took, self.wall = list[float](), list[float]()
        self.relaxed = 0
        if isinstance(posture, ImpactRobustPosture | ReferenceFlowPosture):
            posture.brace()

    def tick(self, k: int) -> None:
        task, rate, t = self.task, self.rate, k * DT
        position = self.home + self.amplitude * np.sin(rate * t)
        task.target = pin.SE3(task.target.rotation, position) if isinstance(task, FramePose) else position
        task.target_velocity[:3] = self.amplitude * rate * np.cos(rate * t)
        task.target_acceleration[:3] = -self.amplitude * rate**2 * np.sin(rate * t)
        began, busy = time.perf_counter_ns(), time.thread_time_ns()
        command = self.controller.tick(t, self.q, self.v)
        self.took.append((time.thread_time_ns() - busy) / 1e3)
        self.wall.append((time.perf_counter_ns() - began) / 1e3)
        if command.status not in (Status.SOLVED, Status.RELAXED):
            raise SystemExit(f"{self.robot.name}, tick {k}: {command.status}")
        self.relaxed += command.status is Status.RELAXED
        self.v = self.v + DT * command.acceleration
        self.q = np.asarray(pin.integrate(self.robot.model, self.q, DT * self.v))

    @property
    def usual(self) -> Vector:
        """Return the median of the times, and the mean of the shortest 99 %, which excludes most interruptions."""
        took = np.sort(self.took)
        return np.array([np.median(took), took[: int(0.99 * took.size)].mean()])


def lines(request: Request) -> Iterator[str]:
    """Yield a row with times of ticks and a row with times of solvers for each robot."""
    yield from (machine("daqp"), "")
    yield (
        f"{request.count} ticks, one core; impact-robust controller, bracing. Processor time of a tick, "
        "µs. Wall time\n"
        "includes other programs on the machine. Robust / nominal: ratio of medians, and of means of the shortest\n"
        "99 %, with the gradient every fifth tick (in brackets: every tick). Flow: controller with a moving\n"
        "reference flow, with the ratio of means of the shortest 99 % and the 99th percentile."
    )
    yield ""
    solvers = []

    def rows() -> Iterator[list[str]]:
        for name in (name for name in GOALS if request.only in name):
            with one_core(), tempfile.TemporaryDirectory() as folder:
                objective = CASES[name].problem().objective
                export(objective, Path(folder), check=False)
                gradient = gradient_of(ImpactGradient.load(folder, robot=objective.robot))
                yield _ticks(name, objective.robot, gradient, request)
                solvers.append(_solvers(name, objective.robot, gradient, min(request.count, 500)))

    yield from table(_TICKS, rows())
    yield from (
        "",
        "The QP of a tick, median µs; in brackets the largest relative difference from DAQP's solution:",
        "",
    )
    yield from table(["robot", "variables", "rows", "DAQP, warm", *[f"{name}, cold" for name in _OTHERS]], solvers)


def _postures(
    robot: Robot, gradient: Gradient, every: int = 5
) -> tuple[JointPosture, ImpactRobustPosture, ReferenceFlowPosture]:
    """Return the nominal, the impact-robust and the reference-flow posture task, with equal gains apart from K."""
    aerial = robot.spec.kind == "aerial"
    more = {} if aerial else {"kp": 20.0, "weight": 0.1, "base_weight": 0.0}
    return (
        JointPosture(robot, **more),
        ImpactRobustPosture(robot, gradient, K=10.0 if aerial else 20.0, every=every, **more),
        ReferenceFlowPosture(robot, gradient, **more),
    )


def _ticks(name: str, robot: Robot, gradient: Gradient, request: Request) -> list[str]:
    amplitude, most, most_p99 = GOALS[name]
    postures = [*_postures(robot, gradient), _postures(robot, gradient, every=1)[1]]
    nominal, robust, flow, often = flights = [Flight(amplitude, robot, posture) for posture in postures]
    gc.collect()
    for k in range(request.count):
        # The controllers run in turn, so that other programs disturb all of them equally.
        for flight in flights:
            flight.tick(k)
    middle, late, ratio = robust.usual[0], np.percentile(robust.took, 99), robust.usual / nominal.usual
    flowing = flow.usual[1] / nominal.usual[1]
    if flowing > FLOW_RATIO:
        request.missed.append(f"{robot.name}: {FLOW_RATIO} × nominal for the flow")
    if middle > most or late > most_p99 or ratio[0] > RATIO:
        request.missed.append(f"{robot.name}: {most} µs, {most_p99} µs, {RATIO} × nominal")
    fifth, each = (", ".join(f"{value:.3f}" for value in values) for values in (ratio, often.usual / nominal.usual))
    walls = [f"{np.median(robust.wall):.0f}", f"{np.percentile(robust.wall, 99):.0f}"]
    cells = [robot.name, f"{middle:.0f}", f"{late:.0f}", f"{most}, {most_p99}", *walls]
    return [
        *cells,
        f"{middle / crba_time(robot.model) / 1e6:.0f}",
        f"{fifth} ({each})",
        f"{flowing:.2f}",
        f"{np.percentile(flow.took, 99):.0f}",
        str(robust.relaxed),
    ]


def _solvers(name: str, robot: Robot, gradient: Gradient, ticks: int) -> list[str]:
    flight = Flight(GOALS[name][0], robot, _postures(robot, gradient)[1])
    flight.controller._solver = clock = Timed(flight.controller._solver)
    for k in range(ticks):
        flight.tick(k)
    qp = flight.controller.assembly.qp
    others = [_other(QpsolversSolver(other, **settings), clock.kept) for other, settings in _OTHERS.items()]
    return [robot.name, str(qp.n), str(qp.m), f"{np.median(clock.times):.0f}", *others]


def _other(solver: QpsolversSolver, programs: Sequence[tuple[QP, Solved | None]]) -> str:
    """Return the median time of another solver for the same programs, and the largest difference of its solutions."""
    times, apart = [], 0.0
    for qp, solved in programs:
        began = time.thread_time_ns()
        try:
            answer = solver.solve(qp)
        except qpsolvers.SolverNotFound:
            return "–"
        times.append(time.thread_time_ns() - began)
        if answer is None or solved is None:
            return "failed"
        apart = max(apart, float(np.abs(answer.z - solved.z).max() / np.abs(solved.z).max()))
    return f"{np.median(times) / 1e3:.0f} ({apart:.0e})"
