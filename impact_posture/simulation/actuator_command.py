"""Input and output of a simulated world: commands, pushes, and the true state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from impact_posture.arrays import Array
from impact_posture.settings import Vector3
from impact_posture.simulation.contact_forces import ContactTrace, ShapeTruth


@dataclass(frozen=True, eq=False)
class ActuatorCommand:
    """Joint torques and rotor speeds, without what else the command of a controller holds.

    Attributes:
        torque: Joint torques, N·m (N for prismatic joints), shape (joints,), in the order of ν.
        rotor_speed: Rotor speeds in the unit of ``speed_max`` in robot.toml, shape (rotors,).
    """

    torque: Array
    rotor_speed: Array


@dataclass(frozen=True)
class Push:
    """Force at a point of the robot, constant in the world.

    Attributes:
        frame: The frame that carries the point.
        force: Force, world, N.
        duration: Duration, s, rounded to physics steps.
        offset: The point from the origin of the frame, in the frame, m.
    """

    frame: str
    force: Vector3
    duration: float
    offset: Vector3 = (0.0, 0.0, 0.0)


class Truth(NamedTuple):
    """True state of a world.

    Attributes:
        t: Time since the reset, s.
        q: Configuration, shape (nq,).
        v: ν, shape (nv,).
        rotor_speeds: Rotor speeds in the unit of ``speed_max``, shape (rotors,).
        thrusts: Thrusts, N, shape (rotors,).
        torques: Joint torques of the last step, within the limits, shape (joints,).
        shapes: Contact of each shape with the surfaces, in the order of the scene.
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


class Trace(NamedTuple):
    """True states of a world at n marks, in the words of :class:`Truth`.

    Attributes:
        t: Shape (n,).
        q: Shape (n, nq).
        v: Shape (n, nv).
        rotor_speeds: Shape (n, rotors).
        torques: Shape (n, joints).
        contacts: Contacts of all shapes.
        stopped: Whether each joint with limits is at one of them or beyond, shape (n, limited).
        limited: Names of the joints with limits.
    """

    t: Array
    q: Array
    v: Array
    rotor_speeds: Array
    torques: Array
    contacts: ContactTrace
    stopped: Array
    limited: tuple[str, ...]
