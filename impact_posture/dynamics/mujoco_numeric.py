"""Mass matrix and Jacobians that MuJoCo computes, in Pinocchio coordinates, as an independent check of Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.dynamics.mjcf import build_mjcf, import_mujoco
from impact_posture.system.arrays import Array


class MujocoNumeric:
    """Compute dynamics of a ``pin.Model`` with MuJoCo at one configuration.

    The method :meth:`at` sets the configuration and must be called first.  All vectors and matrices are in the order
    and tangent space of Pinocchio.

    Raises:
        InputError: MuJoCo is not installed.
    """

    def __init__(self, model: pin.Model) -> None:
        self._mujoco = import_mujoco()
        self.mjcf = build_mjcf(model)
        self.model = self.mjcf.compile()
        self.data = self._mujoco.MjData(self.model)
        self._map = np.eye(model.nv)

    def at(self, q: Array) -> MujocoNumeric:
        """Set the configuration to ``q``, shape (nq,)."""
        self.data.qpos[:] = self.mjcf.layout.qpos(q)
        self._mujoco.mj_fwdPosition(self.model, self.data)
        self._map = self.mjcf.layout.velocity_map(q)
        return self

    def mass_matrix(self) -> Array:
        """Return the mass matrix ``M(q)``, shape (nv, nv), including armature."""
        M = np.zeros((self.model.nv, self.model.nv))
        self._mujoco.mj_fullM(self.model, self.data, M)
        return np.asarray(self._map.T @ M @ self._map)

    def rotation(self, site: str) -> Array:
        """Return the rotation of a frame in the world, shape (3, 3)."""
        return np.array(self.data.site(site).xmat).reshape(3, 3)

    def jacobian(self, site: str, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Return the Jacobian of the linear and angular velocity of a point, in world axes, shape (6, nv).

        ``offset`` is the position of the point in the coordinates of the frame ``site``, m, shape (3,).
        """
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        point = np.array(self.data.site(site).xpos) + self.rotation(site) @ np.asarray(offset, dtype=float)
        body = int(self.model.site(site).bodyid[0])
        self._mujoco.mj_jac(self.model, self.data, linear, angular, point, body)
        return np.asarray(np.vstack([linear, angular]) @ self._map)
