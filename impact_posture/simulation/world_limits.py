"""Limits in a simulated world: of its commands, and of the positions of joints."""

from __future__ import annotations

from typing import Any

import numpy as np

from impact_posture.arrays import Array
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.simulation.actuator_command import ActuatorCommand
from impact_posture.simulation.rotors import Rotors
from impact_posture.tsid.controller import Command

# No robot is so far away or so fast, m, m/s, rad/s, and no torque so large, N·m.
RUNAWAY = 1e6


class CommandLimits:
    """Limits of joint torques and rotor speeds.

    Attributes:
        effort: Largest torques, N·m or N, shape (joints,); infinite where the model states none.
    """

    def __init__(self, robot: Robot, rotors: Rotors | None) -> None:
        propulsion = robot.spec.propulsion
        self._rotors, self._count = rotors, 0 if propulsion is None else len(propulsion.rotors)
        effort = np.asarray(robot.model.effortLimit, dtype=float)[6 if robot.floating else 0 :]
        # An effort limit of zero means that none is stated.
        self.effort: Array = np.where(effort > 0, effort, np.inf)

    def within(self, command: Command | ActuatorCommand) -> tuple[Array, Array]:
        """Return rotor speeds, shape (rotors,), and joint torques, shape (joints,), within their limits.

        Raises:
            InputError: The command has other sizes, is not finite, or has a torque without end.
        """
        speed, torque = np.asarray(command.rotor_speed, dtype=float), np.asarray(command.torque, dtype=float)
        if speed.shape != (self._count,) or torque.shape != self.effort.shape:
            sizes = f"give {self._count} and {self.effort.size}"
            raise InputError(f"{speed.size} rotor speeds and {torque.size} torques", where="command", hint=sizes)
        # A sum of squares that is not absurd settles it.
        with np.errstate(over="ignore"):
            usual = speed.dot(speed) + torque.dot(torque) < RUNAWAY**2
        if not usual and not (np.isfinite(speed).all() and np.isfinite(torque).all()):
            raise InputError("is not finite", where="command", hint="hold the last one instead")
        torque = np.minimum(np.maximum(torque, -self.effort), self.effort)
        if not usual and not np.abs(torque).max(initial=0.0) < RUNAWAY:
            raise InputError("has an endless torque", where="command", hint="give the joints effort limits")
        return speed if self._rotors is None else self._rotors.within(speed), torque


class JointStops:
    """Position limits of joints.

    Attributes:
        names: The joints with limits, in the order of :class:`~impact_posture.simulation.actuator_command.Trace`.

    Args:
        model: The MuJoCo model.
    """

    def __init__(self, model: Any) -> None:
        limited = np.array(model.jnt_limited, dtype=bool)
        self._places = np.array(model.jnt_qposadr)[limited]
        self._low, self._high = np.array(model.jnt_range)[limited].T
        self.names = tuple(model.joint(int(k)).name for k in np.flatnonzero(limited))

    def reached(self, qpos: Array) -> Array:
        """Return the joints that are at a limit, shape (n, joints), for ``qpos`` of shape (n, numbers)."""
        values = qpos[:, self._places]
        return np.asarray((values <= self._low) | (values >= self._high))
