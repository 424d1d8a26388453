"""Readings of imperfect sensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.mjcf_layout import MjcfLayout
from impact_posture.robot.robot import Robot
from impact_posture.simulation.scene import Sensors


@dataclass(frozen=True, eq=False)
class Reading:
    """Measured state.

    Attributes:
        t: Time of the reading, s.  What is measured may be older (``Sensors.delay``).
        q: Configuration, shape (nq,).
        v: ν, shape (nv,).
        force: Force of the surfaces on the robot at the frame of the sensor, world axes, N, shape (3,), after the
            low-pass filter.  ``None`` without a force sensor.
    """

    t: float
    q: Array
    v: Array
    force: Array | None


@dataclass(frozen=True, eq=False)
class Sample:
    """True state after a step, which the sensors see, with speeds and angles of the propellers and the felt force."""

    layout: MjcfLayout
    qpos: Array
    qvel: Array
    speeds: Array
    phases: Array
    force: Array

    @cached_property
    def state(self) -> tuple[Array, Array]:
        """The Pinocchio ``(q, ν)``, which callers must copy."""
        return self.layout.state(self.qpos, self.qvel)


class SensorNoise:
    """White noise in the tangent space, and the steps of the encoders.

    Args:
        robot: The robot.
        sensors: Errors of its sensors.
    """

    def __init__(self, robot: Robot, sensors: Sensors) -> None:
        self._model, self._sensors = robot.model, sensors
        angles, rates = (np.full(robot.nv, value) for value in (sensors.joint_angle, sensors.joint_rate))
        if robot.floating:
            angles[:6] = [sensors.base_position] * 3 + [sensors.base_angle] * 3
            rates[:6] = [sensors.base_velocity] * 3 + [sensors.base_rate] * 3
        self._angles = angles if angles.any() else None
        self._rates = rates if rates.any() else None
        # Only joints with one number have an encoder.
        slots = Chart(robot.model).slots
        self._counted = np.array([s.q.start for s in slots if s.kind.family in ("revolute", "prismatic")], dtype=int)

    def read(self, t: float, q: Array, v: Array, force: Array | None, generator: np.random.Generator) -> Reading:
        """Add noise to the true state.  The given arrays are not changed."""
        sensors = self._sensors
        if self._angles is not None:
            q = pin.integrate(self._model, q, self._angles * generator.standard_normal(self._angles.size))
        if sensors.joint_resolution:
            q = q.copy()
            q[self._counted] = np.round(q[self._counted] / sensors.joint_resolution) * sensors.joint_resolution
        if self._rates is not None:
            v = v + self._rates * generator.standard_normal(self._rates.size)
        if force is not None and sensors.force:
            force = force + sensors.force * generator.standard_normal(3)
        return Reading(t, q, v, force)
