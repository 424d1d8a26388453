"""Speed at which the joints can move the contact along its normal; if the speed is small, they cannot yield."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.model_joints import v_slice
from impact_posture.system.arrays import Array, null_space

# The posture is singular along the normal if the speed of the contact along the normal is below this fraction of its
# largest speed in any direction.
_SINGULAR = 0.05
# A singular value of the Jacobian of the feet below this fraction of the largest one is a rounding error.
_RANK = 1e-9


@dataclass(frozen=True)
class JointYield(JsonBlock):
    """Speed of the contact for a joint velocity of norm 1; the feet are fixed, and the base follows the joints.

    Attributes:
        along: Largest speed of the contact along the normal, m/rad: the singular value of ``nᵀJ`` of the joints.
        largest: Largest speed of the contact in any direction, m/rad: the largest singular value of ``J`` of the
            joints.
    """

    along: float
    largest: float
    derived = ("singular",)

    @property
    def singular(self) -> bool:
        """Whether the joints can hardly move the contact along the normal."""
        return self.along < _SINGULAR * self.largest


def joint_yield(objective: WorstCaseObjective, q: Array) -> JointYield | None:
    """Return how the joints move the first contact at ``q``, shape (nq,); ``None`` if no joint moves this contact."""
    robot, oracle = objective.robot, objective.oracle.at(q)
    moving: NDArray[np.bool_] = np.asarray(robot.projector.any(axis=0))
    if robot.floating and not objective.supports:
        moving[:6] = False
    J, feet = oracle.J[:, moving], oracle.Js[:, moving]
    basis = null_space(feet, _RANK) if len(feet) else np.eye(J.shape[1])
    joints = np.ones(robot.nv, dtype=bool)
    if robot.floating:
        joints[v_slice(robot.model, 1)] = False
    # N is the basis of the motions that keep the feet in place, and N_j its rows for the joints.  Joint velocities v
    # then move the contact by J N N_j⁺ v.
    motion = J @ basis @ np.linalg.pinv(basis[joints[moving]])
    largest = float(np.linalg.norm(motion, 2)) if motion.size else 0.0
    return JointYield(float(np.linalg.norm(oracle.n @ motion)), largest) if largest > 0 else None
