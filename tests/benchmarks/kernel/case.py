"""The robots, the configurations and the numbers that every peer must agree on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.impact.contact import Contact, point_on
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.loader import load_robot
from impact_posture.robot.robot import Robot

Vector = NDArray[np.float64]

FRAMES = {
    "solo8": "base_link",
    "tilthex_arm": "ee",
    "panda": "panda_hand_tcp",
    "talos": "gripper_right_base_link",
}
COUNT = 256


@dataclass(frozen=True)
class Case:
    """One robot, free of supports, W = I, with a normal and a configuration for each call.

    Attributes:
        robot: The robot.
        frame: Contact frame.
        q: Configurations, shape (COUNT, nq).
        n: World unit normals, shape (COUNT, 3).
    """

    robot: Robot
    frame: str
    q: Vector
    n: Vector

    @staticmethod
    def of(name: str) -> Case:
        robot, rng = load_robot(name), np.random.default_rng(0)
        start = robot.posture()
        # The base anywhere in any attitude, the joints some way around the default posture.
        width = np.full(robot.nv, 1.0)
        width[: 6 if robot.floating else 0] = np.pi / 2
        q = [pin.integrate(robot.model, start, rng.uniform(-width, width)) for _ in range(COUNT)]
        n = rng.normal(size=(COUNT, 3))
        return Case(robot, FRAMES[name], np.array(q), n / np.linalg.norm(n, axis=1, keepdims=True))

    @cached_property
    def objective(self) -> ImpactObjective:
        return ImpactObjective(self.robot, Contact.create(self.frame, (0.0, 0.0, 1.0)))

    @property
    def point(self) -> tuple[int, Vector]:
        """Joint that carries the contact point, and the point in its link."""
        found = point_on(self.robot, self.frame)
        return found.joint, np.array(found.position, dtype=float)
