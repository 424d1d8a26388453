"""The constraint that a joint follows another joint."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.robot.joint_coupling import JointCoupling
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


class CoupledJoint(ExpressionConstraint):
    """``q_follower − ratio · q_leader = offset``, in rad or m (:class:`JointCoupling`)."""

    # Violated only if nothing else can be, because the coupling is mechanical.
    price = 10.0

    def __init__(self, robot: Robot, coupling: JointCoupling) -> None:
        self._coupling, model = coupling, robot.model
        joints = [robot.joint_id(coupling.follower), robot.joint_id(coupling.leader)]
        self._q, self._v = ([int(places[k]) for k in joints] for places in (model.idx_qs, model.idx_vs))
        self.name = f"coupling of {coupling.follower}"
        self.parameters = np.zeros(0)
        self.lower = self.upper = np.array([coupling.offset])

    @property
    def structure(self) -> str:
        return f"{super().structure}:{self._q}:{self._coupling.ratio!r}"

    def describe(self) -> str:
        return f"joint '{self._coupling.follower}' moves with '{self._coupling.leader}'"

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        return tree.q[self._q[0]] - self._coupling.ratio * tree.q[self._q[1]]

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        jacobian = np.zeros((1, model.model.nv))
        jacobian[0, self._v] = 1.0, -self._coupling.ratio
        return model.q[self._q[:1]] - self._coupling.ratio * model.q[self._q[1:]], jacobian
