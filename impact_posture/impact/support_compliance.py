"""The compliance ε of supports: default, limits, and the inertia that represents supports in the dynamics."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# Default compliance times the mass of the robot.
_DEFAULT_COMPLIANCE = 1e-4
# Least compliance times the mass of the robot, for which rounding errors remain acceptable.
_LEAST_COMPLIANCE = 1e-6


def default_compliance(robot: Robot) -> float:
    """Return the default support compliance ε, 1/kg, for which a foot acts as if it had the mass of 10⁴ robots.

    The solution of ``M a − J_sᵀ f = Jᵀ n, J_s a + ε f = 0`` is smooth in ``q`` for any ε > 0.  Compliance reduces the
    effect of the feet on the velocity jump by at most the fraction ``ε/(σ + ε)``.  Here, σ is the least eigenvalue of
    ``J_sM⁻¹J_sᵀ`` above zero.  The fraction is 1e-4 if the effective mass at the feet is the mass of the robot, and
    larger if ``J_s`` nearly loses rank.
    """
    return _DEFAULT_COMPLIANCE / robot.mass


def least_compliance(robot: Robot) -> float:
    """Return the least compliance ε, 1/kg, that the symbolic kernel and the C export allow.

    Kernel and C code add ``1/ε`` to the inertia of the feet, and subtract it again on the path to the base.  The
    difference has a rounding error proportional to ``1/ε``.  At the least compliance, about eight digits are correct.
    """
    return _LEAST_COMPLIANCE / robot.mass


def check_compliance(robot: Robot, compliance: float) -> None:
    """Raise ``InputError`` for a support compliance ε, 1/kg, that is below :func:`least_compliance` or not finite."""
    least = least_compliance(robot)
    if not (np.isfinite(compliance) and compliance >= least):
        hint = f"give at least {least:.3g}, which is 1e-6 divided by the mass; stiffer feet cause rounding errors"
        raise InputError(f"the compliance is {compliance:g} 1/kg", where="support_compliance", hint=hint)


def heavy_feet_rounding(robot: Robot, compliance: float) -> float:
    """Return the rounding error of ``M + J_sᵀJ_s/ε`` divided by the rounding error for the default ε, at least 1."""
    return max(1.0, default_compliance(robot) / compliance)


def support_inertia(robot: Robot, supports: tuple[Support, ...], compliance: float) -> dict[int, Array]:
    """Return inertias by joint index, shape (6, 6), that add ``J_sᵀJ_s/ε`` to the mass matrix.

    Each support is a point mass ``1/ε``.  A surface support also has the rotational inertia ``1/ε``.
    """
    extra: dict[int, Array] = {}
    for support in supports:
        point = point_on(robot, support.frame, support.offset)
        jacobian = np.eye(6)
        jacobian[:3, 3:] = -pin.skew(point.position)
        jacobian = jacobian[: support.rows]
        extra[point.joint] = extra.get(point.joint, np.zeros((6, 6))) + jacobian.T @ jacobian / compliance
    return extra
