"""Extensions from outside the package: an objective, a constraint, a task, and a controller of experiments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

import impact_posture as ip
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError
from impact_posture.impact.contact import ImpactContact, Support
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.objective import Objective
from impact_posture.impact.worst_case import Subgradients
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.constraint import Constraint
from impact_posture.posture.null_space_path import null_space_path
from impact_posture.posture.problem import Requirements
from impact_posture.posture.solve import solve
from impact_posture.robot.robot import Robot
from impact_posture.simulation.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.driver import Driver
from impact_posture.simulation.run import run
from impact_posture.simulation.scenario import Setup
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.simulation.task_formulations import nominal_posture
from impact_posture.tsid.state import State

from .helpers import Vector, robot
from .simulation.factories import needs_mujoco, shortened


@dataclass(frozen=True)
class JointDistance:
    """``1 + ‖q − q*‖²`` of a robot whose joints are all revolute."""

    robot: Robot
    target: tuple[float, ...]
    name: str = "joint-distance"
    contacts: tuple[ImpactContact, ...] = ()
    supports: tuple[Support, ...] = ()
    structure: str = "joint-distance"
    attempts: int = 1

    @property
    def parameters(self) -> Vector:
        return np.array(self.target)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        return Lifted(ca.SX(0, 1), ca.SX(0, 1), 1 + ca.sumsqr(tree.q - parameters))

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        return Guess(np.zeros(0), np.zeros(0))

    def value(self, q: Vector) -> float:
        return float(1 + np.sum((q - self.parameters) ** 2))

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        return Subgradients(2 * (q - self.parameters)[None, :], np.zeros(1))

    def movable(self, q: Vector) -> bool:
        return True

    def blind_motions(self) -> Vector:
        return np.zeros((0, 6))


class Coupled(Constraint):
    """The first two joints' angles add up to a value."""

    def __init__(self, total: float) -> None:
        self.name = "coupled joints"
        self.parameters = np.array([total])
        self.lower = self.upper = np.zeros(1)

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return tree.q[0] + tree.q[1] - parameters

    def evaluate(self, model: Numeric) -> tuple[Vector, Vector]:
        return np.array([model.q[0] + model.q[1] - self.parameters[0]]), np.eye(model.model.nv)[:2].sum(0)[None]


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_another_objective_with_another_constraint(name: str) -> None:
    arm = robot(name)
    start = arm.posture()
    target = start + 0.1
    objective: Objective = JointDistance(arm, tuple(target))
    problem = build_problem(arm, objective, start, Requirements(contact_pose="free"))
    total = float(start[0] + start[1]) - 0.1
    problem = replace(problem, constraints=(*problem.constraints, Coupled(total)))
    assert "coupled joints held" in problem.describe()
    solution = solve(problem, starts=2, jobs=1)
    expected = np.clip(target, problem.lower, problem.upper)
    # The projection of the target onto q₁ + q₂ = c moves both joints alike.
    expected[:2] += (total - expected[:2].sum()) / 2
    assert solution.certificate.holds()
    np.testing.assert_allclose(solution.q, expected, atol=1e-7)
    with pytest.raises(InputError, match="joint-distance"):
        null_space_path(problem, start, solution.q)


class JointAngle(ip.tsid.Task):
    """The angle of a joint with one number in ``q``: ``e = target − q_j``."""

    def __init__(self, robot: Robot, joint: str, target: float, kp: float, weight: float = 1.0) -> None:
        super().__init__(f"angle of {joint}", 1, kp=kp, weight=weight)
        index = robot.joint_id(joint)
        self.target, self.entry = target, int(robot.model.idx_qs[index])
        self.row = np.eye(robot.nv)[[int(robot.model.idx_vs[index])]]

    def error(self, state: State) -> Vector:
        return np.array([self.target - state.q[self.entry]])

    def jacobian(self, state: State) -> Vector:
        return self.row


def test_another_task_in_the_controller() -> None:
    """A critically damped joint: ``e(t) = e₀ (1 + ωt) exp(−ωt)`` with ``ω = √K_p``."""
    arm, dt, omega = robot("panda"), 1e-3, 6.0
    q, v = arm.posture(), np.zeros(arm.nv)
    task = JointAngle(arm, "panda_joint4", q[3] + 0.2, omega**2)
    controller = ip.tsid.Controller(arm, ip.tsid.TaskFormulation(((task,),), posture=ip.tsid.JointPosture(arm)))
    controller.reset(q, v)
    for k in range(500):
        t = k * dt
        expected = 0.2 * (1 + omega * t) * np.exp(-omega * t)
        assert abs(task.target - q[3] - expected) < 2e-3
        command = controller.tick(t, q, v)
        assert command.status is ip.tsid.Status.SOLVED
        v = v + dt * command.acceleration
        q = np.array(pin.integrate(arm.model, q, dt * v))


class SetbackDriver(Driver):
    """Bend a joint before the impact, by a task in the cost that others do not have."""

    def __init__(self, setup: Setup, joint: str, by: float) -> None:
        super().__init__(setup, nominal_posture(setup))
        formulation = self.controller.formulation
        self.task, self.by = JointAngle(setup.robot, joint, 0.0, kp=60.0, weight=200.0), by
        self.controller = ip.tsid.Controller(
            setup.robot,
            replace(formulation, weighted=(*formulation.weighted, self.task)),
            period=setup.scenario.control.period,
        )
        self.bent = False

    def reset(self, q: Vector) -> ip.tsid.Command:
        self.task.target, self.bent = float(q[self.task.entry]), False
        return super().reset(q)

    def brace(self) -> None:
        self.task.target += self.by
        self.bent = True

    @property
    def level(self) -> float:
        return float(self.bent)


class SetbackFactory(ControllerFactory):
    """The controllers of the package and ``setback``."""

    def driver(self, name: str, mode: Mode = "live", gain: float | None = None) -> Driver:
        if name != "setback":
            return super().driver(name, mode, gain)
        return SetbackDriver(self.setup, self.setup.robot.joint_names[-1], -0.15)


def test_another_controller_lives_through_a_scenario() -> None:
    needs_mujoco()
    made = SetbackFactory(shortened("aerial-vertical"), gradient_of=interpreted)
    (bent,), (nominal,) = run(made, "setback"), run(made, "nominal")
    begin = nominal.impacts[0].begin
    before = [found.series.q[np.searchsorted(found.series.t, begin) - 2] for found in (bent, nominal)]
    moved = float(before[0][-1] - before[1][-1])
    assert -0.2 < moved < -0.1
    for found, level in ((bent, 1.0), (nominal, 0.0)):
        assert found.away is None and found.impacts[0].touched
        assert found.series.level[-1] == level
