"""Compare statuses and controls of the exported controller and the Python controller in the same states.

If the controllers differ, an independent certificate (:mod:`tests.support.relaxation_in_c`) decides which is right.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

from docs.studies.core import Vector
from docs.studies.flow import CASES
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.default_formulation import default_formulation
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.libraries import library_path, load_library
from impact_posture.tsid.controller import Command, Controller, Status
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.qp.daqp_solver import DaqpSolver
from impact_posture.tsid.qp.quadratic_program import QP
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture, gradient_of
from tests.support.exported_controller import KINDS, abuse_program, exported, random_state
from tests.support.relaxation_in_c import missed, stationarity
from tests.support.relaxed_ticks import problem_of

HEAD = (
    "robot|states|solved|largest difference of u|over 1e-9|its own|relaxed|status differs (Python/C)|"
    "C: violation, optimality|Python's|held (C)|difference of q_r"
).split("|")
# Largest violation of a hard constraint by a correct solution.
HOLDS = 1e-9
# Largest residual of optimality of a correct solution.
OPTIMAL = 1e-7
# Every SOME-th relaxed tick is certified.
SOME = 20
# Largest number of solved ticks with different controls that are certified.
MOST = 500
# Robots for the measurement of memory growth.
GROWTH = ("tilthex_arm", "panda", "solo8", "talos")


@dataclass(frozen=True)
class States:
    """Kind of states in which the controllers are compared.

    Attributes:
        push: Standard deviation of random joint accelerations by pushes, rad/s² or m/s²; pushes act half of the time.
        size: Size of random, unrelated states; 0 selects the states of a moving robot.
        follows: ``term`` or ``flow`` if the impact-robust term or the reference flow is active.
        again: Number of ticks after which the robot returns to its start, because it may have fallen.
    """

    push: float = 0.0
    size: float = 0.0
    follows: str = ""
    again: int = 1000


STATES = {
    "quiet": States(),
    "braced": States(push=3.0, follows="term"),
    "flowing": States(follows="flow", again=2500),
    "pushed": States(push=3.0),
    "saturated": States(push=30.0),
    "random": States(size=0.05),
    "far": States(size=0.3),
}


@dataclass
class Agreement:
    """Comparison of both controllers over the ticks of one kind of states.

    Attributes:
        solved: Number of ticks that both controllers solved.
        worst: Largest relative difference between the controls in these ticks.
        differ: Number of solved ticks whose controls differ by more than 1e-9.
        own: Largest relative change of the Python controls in the solved ticks if the last digits of the QP change.
        relaxed: Number of ticks that both controllers relaxed.
        other: Number of ticks with different statuses, keyed by ``Python/C``.
        held: Number of ticks in which the controller in C failed and repeated its last command.
        off: Largest violation and residual of optimality in the certified ticks; rows: C, Python.
        wrong: Number of certified ticks in which the answer of C, or of Python, is wrong.
        reference: Largest difference between the postures that both flows have reached, rad or m.
    """

    solved: int = 0
    worst: float = 0.0
    differ: int = 0
    own: float = 0.0
    relaxed: int = 0
    other: Counter[str] = field(default_factory=Counter)
    held: int = 0
    off: Vector = field(default_factory=lambda: np.zeros((2, 2)))
    wrong: Vector = field(default_factory=lambda: np.zeros(2, dtype=int))
    reference: float = 0.0

    def row(self, name: str, kind: str) -> list[str]:
        other = ", ".join(f"{count} {pair}" for pair, count in sorted(self.other.items())) or "none"
        ours, theirs = (
            f"{violation:.0e}, {optimality:.0e}" + (f" ({wrong} not right)" if wrong else "")
            for (violation, optimality), wrong in zip(self.off, self.wrong, strict=True)
        )
        return [name, kind, str(self.solved), f"{self.worst:.0e}", str(self.differ), f"{self.own:.0e}",
                str(self.relaxed), other, ours, theirs, str(self.held), f"{self.reference:.0e}"]  # fmt: skip


def objective_of(name: str) -> WorstCaseObjective:
    """Return the objective that the reference flow of a robot minimizes in the studies."""
    return next(case for case in CASES if case.robot == name).problem().objective


def pair(name: str, follows: str) -> tuple[Controller, CompiledController]:
    """Return a robot's controllers in Python and in C.  Both controllers call the same compiled gradient."""
    objective = objective_of(name) if follows else None
    folder = exported(name, objective, "-O2", () if follows == "flow" else None)
    robot = load_robot(name) if objective is None else objective.robot
    formulation = default_formulation(robot, KINDS[name], objective, flow=follows == "flow")
    if isinstance(posture := formulation.posture, ImpactRobustPosture | ReferenceFlowPosture):
        metric = read_manifest(folder / "ctl_metric.json")[0]
        posture._function = gradient_of(ImpactGradient(load_library(library_path(folder, "ctl")), metric))
    return Controller(robot, formulation), CompiledController.load(folder, robot=robot)


def agreement(name: str, kind: str, ticks: int) -> Agreement:
    """Run both controllers in the same states: random states, or states of a robot under the Python controller."""
    states, tally = STATES[kind], Agreement()
    (ours, theirs), rng = pair(name, states.follows), np.random.default_rng(7)
    robot, posture, push = ours.robot, ours.formulation.posture, np.zeros(ours.robot.nv)
    q, v = robot.posture(), np.zeros(robot.nv)
    phases = {0: "brace", 7 * states.again // 10: "contact", 9 * states.again // 10: "release"}
    for k in range(ticks):
        if states.size:
            q, v = random_state(robot, rng, states.size)
        elif k % states.again == 0:
            q, v = robot.posture(), np.zeros(robot.nv)
        if k == 0 or (states.follows and k % states.again == 0):
            for controller in (ours, theirs):
                controller.reset(robot.posture(), np.zeros(robot.nv))
        if states.follows and (phase := phases.get(k % states.again)):
            getattr(posture, phase)()
            getattr(theirs, phase)()
        a, b = ours.tick(1e-3 * k, q, v), theirs.tick(1e-3 * k, q, v)
        _compare(tally, ours, a, b)
        if isinstance(posture, ReferenceFlowPosture):
            away = pin.difference(robot.model, posture.target, theirs.target)
            tally.reference = max(tally.reference, float(np.max(np.abs(away))))
        if k % 50 == 0:
            push = states.push * rng.normal(size=robot.nv) * (k % 100 == 0)
        v = v + 1e-3 * (a.acceleration + push)
        q = np.asarray(pin.integrate(robot.model, q, 1e-3 * v))
    return tally


def _compare(tally: Agreement, ours: Controller, a: Command, b: Command) -> None:
    """Compare the commands of one tick, and add the result to ``tally``.  Certify both solutions if they differ, and
    in every SOME-th relaxed tick.
    """
    answered, certify = (Status.SOLVED, Status.RELAXED), a.status is not b.status
    tally.held += b.status not in answered
    if certify:
        tally.other[f"{a.status.value}/{b.status.value}"] += 1
    elif a.status is Status.SOLVED:
        tally.solved += 1
        difference = _difference(a.u, b.u)
        tally.worst, certify = max(tally.worst, difference), difference > 1e-9
        tally.differ += certify
        certify &= tally.differ <= MOST
        if certify:
            tally.own = max(tally.own, _difference(a.u, _moved(ours)))
    elif a.status is Status.RELAXED:
        tally.relaxed += 1
        certify = tally.relaxed % SOME == 1
    for i, command in enumerate((b, a) if certify else ()):
        if command.status in answered:
            z = np.concatenate([command.acceleration, command.forces])
            program = problem_of(ours.assembly, z)
            off = missed(program, z)[0], max(stationarity(program, z))
            tally.off[i] = np.maximum(tally.off[i], off)
            tally.wrong[i] += not (off[0] <= HOLDS and off[1] <= OPTIMAL)


def _difference(u: Vector, other: Vector) -> float:
    return float(np.max(np.abs(u - other)) / max(1.0, float(np.max(np.abs(u)))))


def _moved(controller: Controller) -> Vector:
    """Return the controls for the last QP if the last digit of each of its numbers changes."""
    qp, rng = controller.assembly.rank.qp, np.random.default_rng(0)
    digits = np.finfo(float).eps * rng.choice([-1.0, 1.0], size=(qp.n, qp.n))
    bounds = 1.0 + np.finfo(float).eps * rng.choice([-1.0, 1.0], size=qp.n + qp.m)
    H, A = qp.H * (1.0 + np.tril(digits) + np.tril(digits, -1).T), qp.A * (1.0 + digits[0])
    moved = QP(H, qp.g * (1.0 + digits[0]), A, bounds * qp.lower, bounds * qp.upper, qp.sense)
    solved = DaqpSolver(qp.n, qp.m).solve(moved)
    return (
        np.full(controller.actuators.controls, np.nan)
        if solved is None
        else (controller.assembly.controls(controller.state, solved.z))
    )


def equality(ticks: int) -> Iterator[list[str]]:
    """Yield a row for each robot and kind of states."""
    for name in KINDS:
        for kind in STATES:
            yield agreement(name, kind, ticks).row(name, kind)


def growth(ticks: int) -> Iterator[list[str]]:
    """Yield the growth of memory for each robot in random ticks, half of which have very tight limits."""
    for name in GROWTH:
        with tempfile.TemporaryDirectory() as scratch:
            program = abuse_program(exported(name, flags="-O2"), Path(scratch))
            ran = subprocess.run([program, str(ticks)], capture_output=True, text=True, check=True)
        yield [name, str(ticks), *ran.stdout.strip().removeprefix("growth ").split("; statuses ")]
