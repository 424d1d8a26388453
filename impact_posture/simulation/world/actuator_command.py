"""Input and output of a simulated world: commands and their limits, pushes, joint limits, and the true state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from impact_posture.config.problem_settings import Vector3
from impact_posture.errors import InputError
from impact_posture.robot.actuation import torque_limits
from impact_posture.robot.robot import Robot
from impact_posture.simulation.world.contact_forces import ShapeTruth
from impact_posture.simulation.world.rotors import Rotors
from impact_posture.system.arrays import Array
from impact_posture.system.optional_package import import_mujoco
from impact_posture.tsid.controller import Command

# The state has diverged if a position (m), speed (m/s, rad/s) or torque (N·m) is larger than this.
RUNAWAY = 1e6


@dataclass(frozen=True, eq=False)
class ActuatorCommand:
    """Joint torques and rotor speeds: the part of a controller's command that the actuators execute.

    Attributes:
        torque: Joint torques, N·m (N for prismatic joints), shape (joints,), in the order of ν.
        rotor_speed: Rotor speeds in the unit of ``speed_max`` in robot.toml, shape (rotors,).
    """

    torque: Array
    rotor_speed: Array


class CommandLimits:
    """Limits of rotor speeds and joint torques.

    The torque limits ``effort`` (N·m or N) are infinite for joints to which the model gives no limit.
    """

    def __init__(self, robot: Robot, rotors: Rotors | None) -> None:
        propulsion = robot.spec.propulsion
        self._rotors, self._count = rotors, 0 if propulsion is None else len(propulsion.rotors)
        self.effort = torque_limits(robot.model)[robot.first_joint :]

    def within(self, command: Command | ActuatorCommand) -> tuple[Array, Array]:
        """Return rotor speeds, shape (rotors,), and joint torques, shape (joints,), within their limits.

        Raises:
            InputError: A size is wrong, a number is not finite, or the torque of a joint without limit is at least
                :data:`RUNAWAY`.
        """
        speed, torque = np.asarray(command.rotor_speed, dtype=float), np.asarray(command.torque, dtype=float)
        if speed.shape != (self._count,) or torque.shape != self.effort.shape:
            sizes = f"give {self._count} and {self.effort.size}"
            raise InputError(f"{speed.size} rotor speeds and {torque.size} torques", where="command", hint=sizes)
        # If the sum of squares is below ``RUNAWAY²``, every number is finite and below ``RUNAWAY``.
        with np.errstate(over="ignore"):
            usual = speed.dot(speed) + torque.dot(torque) < RUNAWAY**2
        if not usual and not (np.isfinite(speed).all() and np.isfinite(torque).all()):
            raise InputError("is not finite", where="command", hint="repeat the last command instead")
        torque = np.minimum(np.maximum(torque, -self.effort), self.effort)
        if not usual and not np.abs(torque).max(initial=0.0) < RUNAWAY:
            raise InputError("a torque is too large", where="command", hint="give the joints effort limits")
        return speed if self._rotors is None else self._rotors.within(speed), torque


@dataclass(frozen=True)
class Push:
    """Force at a point of the robot, constant in the world frame.

    Attributes:
        frame: Frame of the point.
        force: Force, world, N.
        duration: Duration, s, rounded to a whole number of physics steps.
        offset: Position of the point in the coordinates of ``frame``, m.
    """

    frame: str
    force: Vector3
    duration: float
    offset: Vector3 = (0.0, 0.0, 0.0)


class ActivePushes:
    """Pushes that act on a world.

    ``active`` lists, for each push, the body, the point in body coordinates, the force, and the step at which it
    ends.
    """

    def __init__(self, model: Any) -> None:
        self._model, self._apply = model, import_mujoco().mj_applyFT
        self.active: list[tuple[int, Array, Array, int]] = []

    def in_c(self) -> dict[str, Any]:
        """Return the values of the pushes for the struct in ``c/world_ticks.c``."""
        bodies, points, forces, ends = zip(*self.active, strict=True) if self.active else ((), (), (), ())
        return {"pushes": len(bodies), "push_body": bodies, "push_end": ends,
                "push": [[*point, *force] for point, force in zip(points, forces, strict=True)]}  # fmt: skip

    def begin(self, push: Push, body: int, point: Array, step: int) -> None:
        """Begin a push at ``point`` in the coordinates of ``body``; raise the errors of :meth:`World.push`."""
        count = round(push.duration / self._model.opt.timestep) if np.isfinite(push.duration) else 0
        if count < 1 or not np.isfinite(push.force).all():
            raise InputError("the force or the duration is invalid", where=f"push at '{push.frame}'",
                             hint="give a finite force in N, and at least one time step in s")  # fmt: skip
        self.active.append((body, point, np.array(push.force, dtype=float), step + count))

    def apply(self, data: Any, step: int) -> None:
        """Apply the forces in a step, and remove the pushes that have ended."""
        data.qfrc_applied[:] = 0.0
        self.active = [push for push in self.active if push[-1] > step]
        for body, point, force, _ in self.active:
            place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
            self._apply(self._model, data, force, np.zeros(3), place, body, data.qfrc_applied)


class JointStops:
    """Position limits of joints.  ``names`` has the order of the columns of ``Trace.stopped``."""

    def __init__(self, model: Any) -> None:
        limited = np.array(model.jnt_limited, dtype=bool)
        self._places = np.array(model.jnt_qposadr)[limited]
        self._low, self._high = np.array(model.jnt_range)[limited].T
        self.names = tuple(model.joint(int(k)).name for k in np.flatnonzero(limited))

    def reached(self, qpos: Array) -> Array:
        """Return whether each joint is at or beyond a limit, shape (n, joints).

        ``qpos`` contains the MuJoCo positions of n states, shape (n, numbers).
        """
        values = qpos[:, self._places]
        return np.asarray((values <= self._low) | (values >= self._high))


class Truth(NamedTuple):
    """True state of a world.

    Attributes:
        t: Time since the reset, s.
        q: Configuration, shape (nq,).
        v: Generalized velocity ν, shape (nv,).
        rotor_speeds: Rotor speeds in the unit of ``speed_max``, shape (rotors,).
        thrusts: Thrusts, N, shape (rotors,).
        torques: Joint torques of the last step, after clipping to the limits, shape (joints,).
        shapes: Contact of each shape with the surfaces, in the order of the shapes in the scene.
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
    """True states at n calls of :meth:`World.mark`, with the quantities of :class:`Truth` and :class:`ShapeTruth`.

    The first axis of each array has n entries.  The second axis of ``stopped`` has one entry per joint with limits.
    The second axis of the arrays after ``stopped`` has one entry per shape.
    """

    t: Array
    q: Array
    v: Array
    rotor_speeds: Array
    torques: Array
    stopped: Array
    touching: Array
    force: Array
    impulse: Array
    peak: Array
    began: Array
    slip: Array
