"""A controller for the experiments in a separate package: it bends the last joint before the impact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import impact_posture as ip
from impact_posture.robot.robot import Robot
from impact_posture.simulation.controllers.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.controllers.driver import Driver
from impact_posture.simulation.controllers.task_formulations import nominal_posture
from impact_posture.simulation.setup import Setup
from impact_posture.tsid.state import State

Vector = NDArray[np.float64]


class JointAngle(ip.tsid.Task):
    """Move a joint that has one coordinate in ``q`` to an angle: ``e = target − q_j``."""

    def __init__(self, robot: Robot, joint: str, target: float, kp: float, weight: float = 1.0) -> None:
        super().__init__(f"angle of {joint}", 1, kp=kp, weight=weight)
        index = robot.joint_id(joint)
        self.target, self.entry = target, int(robot.model.idx_qs[index])
        self.row = np.eye(robot.nv)[[int(robot.model.idx_vs[index])]]

    def error(self, state: State) -> Vector:
        return np.array([self.target - state.q[self.entry]])

    def jacobian(self, state: State) -> Vector:
        return self.row


class SetbackDriver(Driver):
    """Bend a joint before the impact, with an additional task in the cost."""

    def __init__(self, setup: Setup, joint: str, by: float, kp: float) -> None:
        super().__init__(setup, nominal_posture(setup))
        formulation = self.controller.formulation
        self.task, self.by = JointAngle(setup.robot, joint, 0.0, kp=kp, weight=200.0), by
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


def setback(factory: ControllerFactory, mode: Mode, gain: float | None) -> Driver:
    """Build the controller; pyproject.toml names this function."""
    setup = factory.setup
    return SetbackDriver(setup, setup.robot.joint_names[-1], by=-0.15, kp=60.0 if gain is None else gain)
