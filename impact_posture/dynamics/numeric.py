"""Kinematics and dynamics computed with Pinocchio, used as the reference for the symbolic results."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.tree import PointOnLink
from impact_posture.robot.model_joints import finite_armature
from impact_posture.system.arrays import Array


class Numeric:
    """Compute kinematics, mass matrix and their tangent derivatives at one configuration.

    The method :meth:`at`, which must be called first, sets the configuration.

    Attributes:
        locked: True for the velocity entries of joints that an infinite armature locks, shape (nv,).
    """

    def __init__(self, model: pin.Model) -> None:
        # Gravity has no effect in an impact.  Without gravity, RNEA at zero velocity returns exactly M(q) a.
        self.model = model.copy()
        self.model.gravity = pin.Motion.Zero()
        self.model.armature, self.locked = finite_armature(model)
        self.data = self.model.createData()
        self.q = pin.neutral(model)
        self._zero, self._below = np.zeros(model.nv), np.tril_indices(model.nv, -1)

    def at(self, q: Array) -> Numeric:
        """Set the configuration to ``q``, shape (nq,)."""
        self.q = np.array(q, dtype=float)
        pin.computeJointJacobians(self.model, self.data, self.q)
        return self

    def mass_matrix(self) -> Array:
        """Return ``M(q)`` with armature, shape (nv, nv).  Locked joints are treated as if they could move."""
        M = np.array(pin.crba(self.model, self.data, self.q)).reshape(2 * (self.model.nv,))
        M[self._below] = M.T[self._below]
        return M

    def placement(self, point: PointOnLink) -> pin.SE3:
        """Return the world placement of the frame of a point."""
        return self.data.oMi[point.joint] * point.placement

    def jacobian(self, point: PointOnLink) -> Array:
        """Return the Jacobian of linear and angular velocity in world axes (LOCAL_WORLD_ALIGNED), shape (6, nv)."""
        J = pin.getFrameJacobian(self.model, self.data, point.joint, point.placement, pin.LOCAL_WORLD_ALIGNED)
        return np.asarray(J).reshape(6, -1)

    def center_of_mass(self) -> tuple[Array, Array]:
        """Return the world position of the center of mass, shape (3,), and its Jacobian, shape (3, nv)."""
        J = np.array(pin.jacobianCenterOfMass(self.model, self.data, self.q)).reshape(3, -1)
        return np.array(self.data.com[0]), J

    def inertial_gradient(self, left: Array, right: Array) -> Array:
        """Return the tangent gradient of ``leftᵀ M(q) right``, shape (nv,), from the derivatives of RNEA."""
        dtau_dq = pin.computeRNEADerivatives(self.model, self.data, self.q, self._zero, right)[0]
        gradient = np.asarray(dtau_dq).reshape(self.model.nv, -1).T @ left
        self.at(self.q)  # computeRNEADerivatives changed the data
        return np.asarray(gradient)

    def coupling_gradient(self, point: PointOnLink, wrench: Array, v: Array, *, in_frame: bool = False) -> Array:
        """Return the tangent gradient of ``wᵀ J(q) v``, shape (nv,).

        If ``in_frame``, ``w`` is constant in the frame of the point; otherwise, ``w`` is constant in the world.  The
        LOCAL_WORLD_ALIGNED derivatives of Pinocchio omit the rotation of the frame.  Therefore the LOCAL derivatives
        are computed and rotated to world axes.
        """
        pin.computeForwardKinematicsDerivatives(self.model, self.data, self.q, v, self._zero)
        frame = self.model, self.data, point.joint, point.placement, pin.LOCAL
        dv_dq = np.asarray(pin.getFrameVelocityDerivatives(*frame)[0]).reshape(6, -1)
        motion = point.placement.actInv(self.data.v[point.joint])
        self.at(self.q)
        if in_frame:
            return np.asarray(dv_dq.T @ wrench)
        R = self.placement(point).rotation.T
        force, moment = R @ wrench[:3], R @ wrench[3:]
        angular = np.asarray(pin.getFrameJacobian(*frame)).reshape(6, -1)[3:]
        turning = _cross(motion.linear, force) + _cross(motion.angular, moment)
        return np.asarray(dv_dq.T @ np.concatenate([force, moment]) + angular.T @ turning)

    def turning_gradient(self, point: PointOnLink, direction: Array, covector: Array) -> Array:
        """Return the tangent gradient of ``cᵀ d(q)``, shape (nv,), for a direction ``d`` that turns with the link.

        ``d`` and the fixed ``covector`` c are in world axes.
        """
        return np.asarray(self.jacobian(point)[3:].T @ _cross(direction, covector))


def reduced(P: Array, M: Array, *jacobians: Array) -> tuple[Array, ...]:
    """Return ``PᵀMP`` and ``J P`` for the projector ``P`` of a robot (:attr:`Robot.projector`).

    The diagonal of ``PᵀMP`` is set to one at the entries that ``P`` ignores, so that the matrix can be inverted.
    """
    ignored = ~P.any(axis=0)
    if not ignored.any():
        return M, *jacobians
    return P.T @ M @ P + np.diag(ignored.astype(float)), *(J @ P for J in jacobians)


def _cross(a: Array, b: Array) -> Array:
    """Return ``a × b`` for 3-vectors; twenty times as fast as ``numpy.cross``."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
