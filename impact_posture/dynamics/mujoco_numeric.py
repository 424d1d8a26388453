"""Mass matrix and Jacobians that MuJoCo computes, in Pinocchio coordinates, as an independent check of Pinocchio."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.dynamics.mjcf_layout import file_layout
from impact_posture.robot.mjcf_file import object_name
from impact_posture.robot.model_joints import finite_armature, q_slice, v_slice
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.optional_package import import_mujoco


class MujocoNumeric:
    """Compute dynamics of a robot with MuJoCo at one configuration.

    The model is the MJCF from which the robot was loaded.  A model from :func:`build_mjcf` replaces the MJCF if the
    robot comes from a URDF, its settings contain a ``mounting``, or a frame in ``frames`` belongs to a joint.

    The method :meth:`at`, which must be called first, sets the configuration.  All vectors and matrices are in the
    order and tangent space of Pinocchio.  Joints with an infinite armature get an armature of zero.

    Raises:
        InputError: MuJoCo is not installed.
    """

    def __init__(self, robot: Robot, frames: Iterable[str]) -> None:
        self._mujoco = import_mujoco()
        model = robot.model.copy()
        model.armature, _ = finite_armature(model)
        moved = robot.settings is not None and robot.settings.mounting
        joint_frames = any(model.frames[robot.frame_id(f)].type == pin.FrameType.JOINT for f in frames)
        self._bodies: dict[str, int] = {}
        if robot.mjcf is None or moved or joint_frames:
            written = build_mjcf(model)
            self.model, self._layout = written.compile(), written.layout
            self._start, moving = np.zeros(model.nq), list(range(1, model.njoints))
            joints = model
        else:
            joints, self._start = robot.mjcf.joints, robot.mjcf.start
            self.model, self._layout = copy(robot.mjcf.model), file_layout(joints)
            moving = [joints.getJointId(name) for name in model.names[1:]]
            self._bodies = {object_name(self.model, "body", b): b for b in range(self.model.nbody)}
        self._sites = {object_name(self.model, "site", s): s for s in range(self.model.nsite)}
        # Entries, in q and ν, of the joints that the robot does not lock.
        self._q, self._v = (np.r_[tuple(part(joints, i) for i in moving)] for part in (q_slice, v_slice))
        if self._bodies:
            armature = np.zeros(joints.nv)
            armature[self._v] = model.armature
            self.model.dof_armature[:] = self._layout.velocity_map(self._start) ** 2 @ armature
            self.model.actuator_armature[:] = 0.0
        self.data = self._mujoco.MjData(self.model)
        self._map = np.eye(joints.nv)

    def at(self, q: Array) -> MujocoNumeric:
        """Set the configuration to ``q``, shape (nq,)."""
        whole = self._start.copy()
        whole[self._q] = q
        self.data.qpos[:] = self._layout.qpos(whole)
        self._mujoco.mj_fwdPosition(self.model, self.data)
        self._map = self._layout.velocity_map(whole)[:, self._v]
        return self

    def mass_matrix(self) -> Array:
        """Return the mass matrix ``M(q)``, shape (nv, nv), including armature."""
        M = np.zeros((self.model.nv, self.model.nv))
        self._mujoco.mj_fullM(self.model, self.data, M)
        return np.asarray(self._map.T @ M @ self._map)

    def rotation(self, frame: str) -> Array:
        """Return the rotation of a frame in the world, shape (3, 3)."""
        return self._pose(frame)[1]

    def jacobian(self, frame: str, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return the Jacobian of the linear and angular velocity of a point, in world axes, shape (6, nv).

        ``offset`` is the position of the point in the coordinates of the frame, m, shape (3,).
        """
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        position, rotation, body = self._pose(frame)
        point = position + rotation @ np.asarray(offset, dtype=float)
        self._mujoco.mj_jac(self.model, self.data, linear, angular, point, body)
        return np.asarray(np.vstack([linear, angular]) @ self._map)

    def _pose(self, frame: str) -> tuple[Array, Array, int]:
        """Return position (m) and rotation of a frame in the world, and the index of its body.

        As in :meth:`~impact_posture.robot.robot.Robot.frame_id`, a body comes before a site of the same name.
        """
        if frame in self._bodies:
            at = self.data.body(self._bodies[frame])
            return np.array(at.xpos), np.array(at.xmat).reshape(3, 3), self._bodies[frame]
        site = self._sites[frame]
        at = self.data.site(site)
        return np.array(at.xpos), np.array(at.xmat).reshape(3, 3), int(self.model.site_bodyid[site])
