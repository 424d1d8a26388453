"""MuJoCo's mass matrix and Jacobians in Pinocchio's coordinates: an opinion that shares no code with Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impact_posture.dynamics.mjcf import import_mujoco, write_mjcf

Vector = NDArray[np.float64]


class MujocoNumeric:
    """A ``pin.Model`` in MuJoCo, at one configuration at a time.

    Call :meth:`at` first; the other methods speak of that configuration.  All vectors and matrices are Pinocchio's:
    its order, its tangent space.

    Raises:
        InputError: MuJoCo is not installed.
    """

    def __init__(self, model: pin.Model) -> None:
        self._mujoco = import_mujoco()
        self.mjcf = write_mjcf(model)
        self.model = self.mjcf.compile()
        self.data = self._mujoco.MjData(self.model)
        self._map = np.eye(model.nv)

    def at(self, q: Vector) -> MujocoNumeric:
        """Move to ``q``, shape (nq,)."""
        self.data.qpos[:] = self.mjcf.layout.qpos(q)
        self._mujoco.mj_fwdPosition(self.model, self.data)
        self._map = self.mjcf.layout.velocity_map(q)
        return self

    def mass_matrix(self) -> Vector:
        """``M(q)``, shape (nv, nv), armature included."""
        found = np.zeros((self.model.nv, self.model.nv))
        self._mujoco.mj_fullM(self.model, self.data, found)
        return np.asarray(self._map.T @ found @ self._map)

    def rotation(self, site: str) -> Vector:
        """World axes of a frame, shape (3, 3)."""
        return np.array(self.data.site(site).xmat).reshape(3, 3)

    def jacobian(self, site: str, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Vector:
        """``J``, shape (6, nv): world linear and angular velocity of a point given in a frame's axes, meters."""
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        point = np.array(self.data.site(site).xpos) + self.rotation(site) @ np.asarray(offset, dtype=float)
        body = int(self.model.site(site).bodyid[0])
        self._mujoco.mj_jac(self.model, self.data, linear, angular, point, body)
        return np.asarray(np.vstack([linear, angular]) @ self._map)
