"""What goes into the world and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from impact_posture.settings import Vector3
from impact_posture.simulation.contact_forces import ShapeTruth

Array = NDArray[np.float64]


class Commands(Protocol):
    """What drives the robot: anything with these two, such as a controller's command."""

    @property
    def torque(self) -> Array:
        """Joint torques, N·m (N for prismatic joints), shape (joints,), in the order of ν."""

    @property
    def rotor_speed(self) -> Array:
        """In the unit of robot.toml's ``speed_max``, shape (rotors,)."""


@dataclass(frozen=True, eq=False)
class ActuatorCommand:
    """Commands as plain numbers; see :class:`Commands`."""

    torque: Array
    rotor_speed: Array


@dataclass(frozen=True)
class Push:
    """A force at a point of the robot, constant in the world.

    Attributes:
        frame: The frame that carries the point.
        force: World, N.
        duration: Seconds; rounded to physics steps.
        offset: The point from the frame's origin, in the frame, meters.
    """

    frame: str
    force: Vector3
    duration: float
    offset: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Truth:
    """The state as it is.

    Attributes:
        t: Seconds since the reset.
        q: Configuration, shape (nq,).
        v: ν, shape (nv,).
        rotor_speeds: In the unit of ``speed_max``, shape (rotors,).
        thrusts: N, shape (rotors,).
        torques: As applied in the last step, within the limits, shape (joints,).
        shapes: What the surfaces do to each shape, in the scene's order.
        at_stops: Joints at or beyond a position limit.
    """

    t: float
    q: Array
    v: Array
    rotor_speeds: Array
    thrusts: Array
    torques: Array
    shapes: tuple[ShapeTruth, ...]
    at_stops: tuple[str, ...]
