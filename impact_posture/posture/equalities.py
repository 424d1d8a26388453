"""What the equalities of a problem hold: their Jacobian on the tangent space, and its rank."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.posture.problem import PostureProblem
from impact_posture.robot.robot import Robot

Vector = NDArray[np.float64]

# A direction of the tangent space counts as held when a unit step along it moves a constraint by more than this.
RANK_TOLERANCE = 1e-7


def rank(jacobian: Vector) -> int:
    """Rank of a constraint Jacobian at the tolerance that all counts of redundancy use."""
    return int(np.linalg.matrix_rank(jacobian, tol=RANK_TOLERANCE)) if jacobian.size else 0


def equality_jacobian(problem: PostureProblem, numeric: Numeric) -> Vector:
    """Tangent Jacobian of all equalities, held joints included, at ``numeric.q``, shape (rows, nv)."""
    blocks = [held_rows(problem.robot, problem.requirements.hold)]
    blocks += [c.evaluate(numeric)[1] for c in problem.constraints if c.equality]
    return np.vstack(blocks)


def held_rows(robot: Robot, hold: Sequence[str]) -> Vector:
    """Unit rows of the tangent entries of held joints, shape (k, nv)."""
    rows: list[int] = []
    for joint in hold:
        index = robot.joint_id(joint)
        rows += range(robot.model.idx_vs[index], robot.model.idx_vs[index] + robot.model.nvs[index])
    return np.eye(robot.nv)[rows]


def base_point() -> PointOnLink:
    """The origin of a floating base's link."""
    return PointOnLink(1, np.zeros(3), np.eye(3))
