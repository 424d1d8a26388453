"""Linear constraints on joints: keep links with overlapping hulls apart, and let coupled joints move together."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from impact_posture.collision.joint_planes import JointPlanes
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint, digest
from impact_posture.robot.joint_coupling import JointCoupling
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


class LinearJoints(ExpressionConstraint):
    """``lower ≤ N θ ≤ upper`` for the positions ``θ`` of revolute or prismatic joints, rad or m.

    ``normals`` is ``N``, shape (rows, joints), and ``text`` describes the constraint.
    """

    def __init__(
        self, robot: Robot, joints: Sequence[str], normals: Array, bounds: tuple[Array, Array], name: str, text: str
    ) -> None:
        ids = [robot.joint_id(joint) for joint in joints]
        self._q, self._v = ([int(places[k]) for k in ids] for places in (robot.model.idx_qs, robot.model.idx_vs))
        self._normals, self._text, self.name = normals, text, name
        self.lower, self.upper = bounds
        self.parameters = np.zeros(0)

    @staticmethod
    def apart(robot: Robot, planes: JointPlanes) -> LinearJoints:
        """Keep two links apart.  Violations are relative to half the range of a joint."""
        name, bounds = " / ".join(planes.bodies), (np.full(planes.bounds.size, -np.inf), planes.bounds)
        text = f"{name} kept apart by the joints {', '.join(planes.joints)}"
        constraint = LinearJoints(robot, planes.joints, planes.normals, bounds, name, text)
        constraint.unit = "of half the joint range"
        return constraint

    @staticmethod
    def coupled(robot: Robot, c: JointCoupling) -> LinearJoints:
        """Let a follower move with its leader: ``q_follower − ratio · q_leader = offset``."""
        name, text = f"coupling of {c.follower}", f"joint '{c.follower}' moves with '{c.leader}'"
        normals, offset = np.array([[1.0, -c.ratio]]), np.array([c.offset])
        constraint = LinearJoints(robot, (c.follower, c.leader), normals, (offset, offset), name, text)
        # The coupling is mechanical, so the search for conflicts violates other constraints first.
        constraint.price = 10.0
        return constraint

    @property
    def structure(self) -> str:
        return f"{super().structure}:{self._q}:{digest(self._normals)}"

    def describe(self) -> str:
        return self._text

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return ca.densify(ca.SX(self._normals) @ tree.q[self._q])

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        jacobian = np.zeros((self.rows, model.model.nv))
        jacobian[:, self._v] = self._normals
        return self._normals @ model.q[self._q], jacobian
