"""The ball of a throw in MuJoCo: a free body whose joint comes after those of the robot."""

from __future__ import annotations

from typing import Any

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.mjcf import Mjcf, import_mujoco
from impact_posture.escape import xml_name
from impact_posture.simulation.throw import FLIGHT, Throw

# Name of the body and of the geom.
BALL = xml_name("thrown ball")
# Where the ball begins to fall until it is thrown, far away from everything, m.
_AWAY = (0.0, 0.0, -1e3)


def add_ball(mjcf: Mjcf, throw: Throw) -> None:
    """Add a solid ball that falls freely, after everything else that moves."""
    moment = 0.4 * throw.mass * throw.radius**2
    inertia = {"mass": throw.mass, "ipos": np.zeros(3), "inertia": np.full(3, moment), "explicitinertial": True}
    body = mjcf.spec.worldbody.add_body(name=BALL, pos=_AWAY, **inertia)
    body.add_freejoint()
    sphere = import_mujoco().mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=BALL, type=sphere, size=(throw.radius, 0.0, 0.0), mass=0.0, contype=0, conaffinity=0)


class Ball:
    """The ball of a compiled model.

    Args:
        model: The MuJoCo model.
        throw: The throw.
    """

    def __init__(self, model: Any, throw: Throw) -> None:
        joint = int(model.body(BALL).jntadr[0])
        self._position, self._velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._target = model.geom(xml_name(f"shape {throw.frame}")).id
        way = np.array(throw.direction) / np.linalg.norm(throw.direction)
        self._velocity_0 = throw.speed * way
        self._reach = (throw.radius + float(model.geom_size[self._target, 0]) + FLIGHT * throw.speed) * way

    def throw(self, data: Any, sign: int) -> None:
        """Put the ball where it touches a shape at rest :data:`FLIGHT` later."""
        start = data.geom_xpos[self._target] - sign * self._reach
        data.qpos[self._position : self._position + 7] = [*start, 1.0, 0.0, 0.0, 0.0]
        data.qvel[self._velocity : self._velocity + 6] = [*(sign * self._velocity_0), 0.0, 0.0, 0.0]

    def state(self, data: Any) -> tuple[Array, Array]:
        """Return position (m) and velocity (m/s) of the center, world, shape (3,) each."""
        q, v = data.qpos[self._position :][:3], data.qvel[self._velocity :][:3]
        return np.array(q), np.array(v)
