"""The constraint that the shapes of two links do not touch, for links whose convex hulls overlap."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.collision.joint_planes import JointPlanes
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint, digest
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


class NestedLinks(ExpressionConstraint):
    """``N θ ≤ b`` for the joints ``θ`` between two links (:class:`JointPlanes`).

    Each joint coordinate is divided by half of the joint range, so violations are relative to this half range.
    """

    unit = "of half the joint range"

    def __init__(self, robot: Robot, planes: JointPlanes) -> None:
        joints = [robot.joint_id(name) for name in planes.joints]
        self._planes = planes
        self._q = [robot.model.idx_qs[k] for k in joints]
        self._v = [robot.model.idx_vs[k] for k in joints]
        self.name = " / ".join(planes.bodies)
        self.parameters = np.zeros(0)
        self.lower, self.upper = np.full(planes.bounds.size, -np.inf), planes.bounds

    @property
    def structure(self) -> str:
        return f"{super().structure}:{self._q}:{digest(self._planes.normals)}"

    def describe(self) -> str:
        return f"{self.name} apart by the joints {', '.join(self._planes.joints)}"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return ca.densify(ca.SX(self._planes.normals) @ tree.q[self._q])

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        normals = self._planes.normals
        jacobian = np.zeros((len(normals), model.model.nv))
        jacobian[:, self._v] = normals
        return normals @ model.q[self._q], jacobian
