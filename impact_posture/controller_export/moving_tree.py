"""Symbolic dynamics for a tick: ``M``, ``h``, and the kinematics of points with their drifts."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from impact_posture.dynamics.kinematics import ByJoint, PointOnLink
from impact_posture.dynamics.model_parameters import ModelParameters
from impact_posture.dynamics.spatial import (
    force_to_parent,
    inertia_to_parent,
    motion_cross,
    motion_cross_force,
    motion_to_child,
    transposed_times,
)
from impact_posture.dynamics.tree import Tree


class MovingTree(Tree):
    """Tree of a ``pin.Model`` at ``(q, ν)``, shapes (nq, 1) and (nv, 1).

    With ``numbers``, armature and joint placements are parameters of the expressions.
    """

    def __init__(self, model: object, q: ca.SX, v: ca.SX, numbers: ModelParameters | None = None) -> None:
        super().__init__(model, q, limbs=numbers)
        self._v, self._moving = v, self.velocities(v)
        self._gravity = ca.SX(np.array(self.model.gravity.linear, dtype=float))

    def mass_matrix(self) -> ca.SX:
        """Return ``M`` with armature, shape (nv, nv), from composite inertias (Featherstone 2008, table 6.2)."""
        composite = dict(self._inertia)
        M = ca.SX(self.nv, self.nv)
        for slot, i, parent in reversed(self._joints):
            if parent:
                moved = inertia_to_parent(composite[i], self._R[i], self._p[i])
                composite[parent] = composite[parent] + moved
            columns = [composite[i] @ self._S[i][:, k] for k in range(slot.kind.nv)]
            j = i
            while j:
                above = self.chart.slots[j - 1]
                block = ca.horzcat(*[transposed_times(self._S[j], column) for column in columns])
                M[above.v, slot.v] = block + (ca.diag(self.armature[slot.v]) if j == i else 0)
                columns = [force_to_parent(self._R[j], self._p[j], column) for column in columns]
                j = self._parents[j]
        return ca.triu2symm(ca.triu(M))

    def bias(self) -> ca.SX:
        """Return ``h``, the generalized force at ``ν̇ = 0`` including gravity, shape (nv,)."""
        forces: ByJoint = {}
        for i, acceleration in self._accelerations.items():
            momentum = self._inertia[i] @ self._moving[i]
            forces[i] = self._inertia[i] @ acceleration + motion_cross_force(self._moving[i], momentum)
        return self._project(self._accumulate(forces))

    def jacobian(self, point: PointOnLink) -> ca.SX:
        """Return the Jacobian of the linear and angular velocity of a point, world axes, shape (6, nv)."""
        J, position = ca.SX(6, self.nv), self.position(point)
        j = point.joint
        while j:
            slot, R = self.chart.slots[j - 1], self.rotations[j]
            linear, angular = R @ self._S[j][:3, :], R @ self._S[j][3:, :]
            J[:3, slot.v] = linear + ca.skew(ca.densify(self.origins[j] - position)) @ angular
            J[3:, slot.v] = angular
            j = self._parents[j]
        return J

    def velocity(self, point: PointOnLink) -> ca.SX:
        """Return the linear and angular velocity ``Jν`` of a point, world axes, shape (6,)."""
        return self.point_velocity(point, self._moving)

    def spatial_drift(self, point: PointOnLink) -> ca.SX:
        """Return the spatial acceleration of a point at ``ν̇ = 0``, world axes, shape (6,)."""
        return self.point_velocity(point, self._accelerations) + ca.vertcat(self._gravity, ca.SX(3, 1))

    @cached_property
    def _accelerations(self) -> ByJoint:
        """Spatial acceleration of every link at ``ν̇ = 0``, minus gravity, in link coordinates."""
        accelerations: ByJoint = {}
        for slot, i, parent in self._joints:
            start = accelerations[parent] if parent else ca.vertcat(-self._gravity, ca.SX(3, 1))
            accelerations[i] = motion_to_child(self._R[i], self._p[i], start)
            if parent:
                # Without a parent, this product is zero, because the link velocity is S ν itself.
                accelerations[i] += motion_cross(self._moving[i], self._S[i] @ self._v[slot.v])
        return accelerations
