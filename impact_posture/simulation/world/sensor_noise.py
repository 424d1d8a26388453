"""Sensor readings with noise, encoder resolution and a filtered force."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.mjcf_layout import MjcfLayout
from impact_posture.robot.robot import Robot
from impact_posture.simulation.world.scene import Sensors
from impact_posture.system.arrays import Array

# Number of readings whose noise is drawn in one call.
_DRAWS = 64


class Reading(NamedTuple):
    """Measured state.

    Attributes:
        t: Time of the reading, s.  The measured state may be older (``Sensors.delay``).
        q: Configuration, shape (nq,).
        v: Generalized velocity ν, shape (nv,).
        force: Filtered force of the surfaces on the shape with the force sensor, world, N, shape (3,); ``None`` if
            there is no force sensor.
    """

    t: float
    q: Array
    v: Array
    force: Array | None


NO_FORCE = [0.0, 0.0, 0.0]


class ForceFilter:
    """First-order low-pass filter of a force.  ``turns`` is the product of cutoff frequency and time step.

    ``force`` is the filtered force, N, three numbers.
    """

    def __init__(self, turns: float) -> None:
        self._share, self.force = -math.expm1(-2 * math.pi * turns), NO_FORCE

    def in_c(self) -> dict[str, Any]:
        """Return the values of the filter for the struct in ``c/world_ticks.c``."""
        return {"share": self._share, "filtered": self.force}

    def feel(self, force: list[float]) -> None:
        """Update the filtered force with the force of one step, N."""
        if force is not NO_FORCE or any(self.force):
            self.force = [old + self._share * (new - old) for old, new in zip(self.force, force, strict=True)]


@dataclass(eq=False, slots=True)
class Sample:
    """True state after a step, with the propellers' speeds and angles and the filtered force."""

    layout: MjcfLayout
    qpos: Array
    qvel: Array
    speeds: Array
    phases: Array
    force: list[float]
    _state: tuple[Array, Array] | None = field(default=None, init=False)

    @property
    def state(self) -> tuple[Array, Array]:
        """``(q, ν)`` in the convention of Pinocchio.  Callers must copy the arrays before they change them."""
        if self._state is None:
            self._state = self.layout.state(self.qpos, self.qvel)
        return self._state


class SensorNoise:
    """White noise on the state, in the tangent space, and rounding of joint angles to the encoder resolution."""

    def __init__(self, robot: Robot, sensors: Sensors) -> None:
        self._model, self._sensors = robot.model, sensors
        angles, rates = (np.full(robot.nv, value) for value in (sensors.joint_angle, sensors.joint_rate))
        if robot.floating:
            angles[:6] = [sensors.base_position] * 3 + [sensors.base_angle] * 3
            rates[:6] = [sensors.base_velocity] * 3 + [sensors.base_rate] * 3
        # For a sensor without noise, no random numbers are drawn.
        force = np.full(0 if sensors.force_frame is None else 3, sensors.force)
        parts = [scale if scale.any() else scale[:0] for scale in (angles, rates, force)]
        self._scales = np.concatenate(parts)
        self._ends = np.cumsum([part.size for part in parts]).tolist()
        # Only joints with a single position value have an encoder.
        slots = Chart(robot.model).slots
        self._counted = np.array([s.q.start for s in slots if s.kind.family in ("revolute", "prismatic")], dtype=int)
        self.reset(np.random.default_rng(0))

    def reset(self, generator: np.random.Generator) -> None:
        """Use ``generator`` for all noise from now on.  No other code may draw from ``generator``."""
        self._generator, self._drawn = generator, iter(np.zeros((0, 0)))

    def draw(self, n: int) -> Array:
        """Return the noise of the next n readings, shape (n, numbers), the same as from n calls with one reading."""
        return np.asarray(self._scales * self._generator.standard_normal((n, self._ends[-1])))

    def in_c(self) -> dict[str, Any]:
        """Return the values of the sensors for the struct in ``c/world_ticks.c``."""
        first, second, third = self._ends
        return {"noises": third, "noisy_q": int(first > 0), "noisy_v": int(second > first),
                "noisy_force": int(third > second), "resolution": self._sensors.joint_resolution}  # fmt: skip

    def read(self, t: float, q: Array, v: Array, force: Array | None) -> Reading:
        """Return the reading for a true state, with noise.  The arguments are not modified."""
        sensors, (first, second, third) = self._sensors, self._ends
        drawn = next(self._drawn, None)
        if drawn is None:
            self._drawn = iter(self.draw(_DRAWS))
            drawn = next(self._drawn)
        q = pin.integrate(self._model, q, drawn[:first]) if first else q.copy()
        if sensors.joint_resolution:
            q[self._counted] = np.rint(q[self._counted] / sensors.joint_resolution) * sensors.joint_resolution
        v = v + drawn[first:second] if second > first else v.copy()
        if force is not None and third > second:
            force = force + drawn[second:]
        return Reading(t, q, v, force)
