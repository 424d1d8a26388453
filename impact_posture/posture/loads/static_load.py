"""Joint torques of a robot at rest, as a CasADi expression and as numbers from Pinocchio.

A robot at rest under gravity satisfies ``τ = h(q) − Σ J_kᵀ w_k``, with the generalized gravity ``h`` and the wrenches
``w_k = W_k z_k + p_k`` of rotors, feet and pushes on the robot.  The generalized force ``τ`` is dual to the
generalized velocity ``ν``.  For a floating base, the first six entries of ``τ`` are the unbalanced wrench on the
base, which no actuator can produce.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.spatial import constant
from impact_posture.dynamics.tree import PointOnLink, Tree, Wrench
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class ForceSource:
    """A wrench ``W z + p`` on a link, with unknowns z, in world axes or in the axes of a frame.

    Attributes:
        point: Point on the link where the wrench acts, with the axes of the frame.
        columns: Matrix ``W``: force (N) above moment (N·m) about the point per unit z, shape (6, k).
        lower, upper: Bounds of z, shape (k,).
        in_frame: Whether the wrench is given in the axes of the frame, so that it turns with the link; otherwise in
            world axes.
        constant: Constant wrench ``p``, N and N·m, shape (6,).
    """

    point: PointOnLink
    columns: Array = field(default_factory=lambda: np.zeros((6, 0)))
    lower: Array = field(default_factory=lambda: np.zeros(0))
    upper: Array = field(default_factory=lambda: np.zeros(0))
    names: tuple[str, ...] = ()
    in_frame: bool = False
    constant: Array = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True, eq=False)
class StaticTorque:
    """``τ(q, z)`` at one posture, shape (nv,), and its derivatives.

    ``by_posture`` is the tangent Jacobian ``∂τ/∂q``, shape (nv, nv), zero if it was not requested.  ``by_force`` is
    ``∂τ/∂z``, shape (nv, k).
    """

    value: Array
    by_posture: Array
    by_force: Array


class StaticLoad:
    """Torques ``τ(q, z)`` of a robot at rest under gravity, with wrenches on its links."""

    def __init__(self, model: pin.Model, sources: Sequence[ForceSource]) -> None:
        self.model, self.sources = model, tuple(sources)
        self._data = model.createData()
        self._parts = np.cumsum([0, *[len(source.lower) for source in self.sources]])
        self.lower, self.upper = (
            np.concatenate([np.zeros(0), *[getattr(source, side) for source in self.sources]])
            for side in ("lower", "upper")
        )
        self.names = tuple(name for source in self.sources for name in source.names)

    @property
    def count(self) -> int:
        """Number of entries of the force vector ``z``."""
        return len(self.lower)

    @property
    def content(self) -> list[object]:
        """All numbers on which the expressions depend."""
        parts = [self.model.gravity.linear, *(inertia.toDynamicParameters() for inertia in self.model.inertias)]
        for source in self.sources:
            point = source.point
            parts += [source.columns, source.constant, point.position, point.rotation, point.joint, source.in_frame]
        return parts

    def split(self, z: Array) -> list[Array]:
        """Split the vector ``z`` into one part for each source."""
        return np.split(z, self._parts[1:-1]) if self.sources else []

    def symbolic(self, tree: Tree, z: ca.SX) -> ca.SX:
        """Return ``τ(q, z)`` as an expression, shape (nv, 1), at ``tree.q``; ``tree`` may belong to another model."""
        tree = tree if tree.model is self.model else Tree(self.model, tree.q)
        wrenches = []
        for source, start, stop in zip(self.sources, self._parts, self._parts[1:], strict=False):
            w = ca.SX(source.columns) @ z[int(start) : int(stop)] + ca.SX(source.constant)
            wrenches.append(Wrench(source.point, w[:3], w[3:], source.in_frame))
        return -tree.generalized_force(wrenches, constant(self.model.gravity.linear))

    def torque(self, q: Array, z: Array, *, by_posture: bool = True) -> StaticTorque:
        """Return ``τ`` and its derivatives at a posture; without ``by_posture``, ``∂τ/∂q`` is not computed.

        Pinocchio computes derivatives for forces that are constant in the axes of the link.  In the axes of the link,
        a force that is constant in the world becomes ``f + f × δ`` if the link turns by δ.
        """
        model, data = self.model, self._data
        if self.sources:
            pin.computeJointJacobians(model, data, q)
        forces = [pin.Force.Zero() for _ in range(model.njoints)]
        by_force = np.zeros((model.nv, self.count))
        turning = np.zeros((model.nv, model.nv))
        joints = {source.point.joint for source in self.sources}
        turned = {joint: np.array(data.oMi[joint].rotation).T for joint in joints}
        jacobians = {
            joint: np.array(pin.getJointJacobian(model, data, joint, pin.LOCAL)).reshape(6, -1) for joint in joints
        }
        for source, part, start in zip(self.sources, self.split(z), self._parts, strict=False):
            point, joint = source.point, source.point.joint
            axes, jacobian = point.rotation if source.in_frame else turned[joint], jacobians[joint]
            arm = pin.skew(point.position)
            local = np.zeros((6, 6))
            local[:3, :3], local[3:, :3], local[3:, 3:] = axes, arm @ axes, axes
            by_force[:, start : start + part.size] = -jacobian.T @ local @ source.columns
            wrench = source.columns @ part + source.constant
            forces[joint] = forces[joint] + pin.Force(local @ wrench)
            if by_posture and not source.in_frame:
                force, moment = pin.skew(axes @ wrench[:3]), pin.skew(axes @ wrench[3:])
                turning += jacobian.T @ np.vstack([force, moment + arm @ force]) @ jacobian[3:]
        external = pin.StdVec_Force()
        external.extend(forces)
        derivative = turning
        if by_posture:
            derivative = np.array(pin.computeStaticTorqueDerivatives(model, data, q, external))
        value = np.array(pin.rnea(model, data, q, np.zeros(model.nv), np.zeros(model.nv), external))
        return StaticTorque(value, derivative - turning, by_force)
