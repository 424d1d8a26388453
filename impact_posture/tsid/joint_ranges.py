"""Joint limits along the entries of ν."""

from __future__ import annotations

import numpy as np

from impact_posture.robot.model_joints import q_slice, v_slice
from impact_posture.robot.robot import Robot


class JointRanges:
    """Position and velocity limits along the entries of ν; infinite position limits for base and continuous joints.

    Attributes:
        lower: Lower position limits, rad or m, shape (nv,).
        upper: Upper position limits, rad or m, shape (nv,).
        velocity: Velocity limits, rad/s or m/s, shape (nv,); infinite if the limit is missing or zero.
        index: Index in ``q`` of each entry of ν with position limits, shape (nv,); arbitrary for the other entries.
    """

    def __init__(self, robot: Robot) -> None:
        model = robot.model
        self.lower, self.upper = np.full(robot.nv, -np.inf), np.full(robot.nv, np.inf)
        self.velocity, self.index = robot.velocity_limits, np.zeros(robot.nv, dtype=np.intp)
        for name in robot.joint_names:
            joint = model.getJointId(name)
            q, v = q_slice(model, joint), v_slice(model, joint)
            if model.nqs[joint] == model.nvs[joint]:
                self.index[v] = np.arange(q.start, q.stop)
                self.lower[v], self.upper[v] = model.lowerPositionLimit[q], model.upperPositionLimit[q]
