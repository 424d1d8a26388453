"""Effect of a velocity jump on the robot: the jump of the base, and the jump of the joint nearest to its limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import json_block
from impact_posture.dynamics.joints import joint_kind
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class WorstJoint:
    """The joint with the largest ratio of velocity jump to velocity limit.

    Attributes:
        name: Name of the joint.
        velocity: Size of the velocity jump of this joint, in ``unit``.
        unit: ``rad/s`` or ``m/s``.
        share: Velocity jump divided by the velocity limit of this joint; ``None`` if no joint has a limit.  Then the
            joint has the largest jump in rad/s, or in m/s if no joint turns.
    """

    name: str
    velocity: float
    unit: str
    share: float | None

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return json_block(self)


@dataclass(frozen=True)
class ImpactEffect:
    """Base and worst joint of a velocity jump.

    Attributes:
        base_linear: Size of the linear velocity jump of a floating base, m/s; ``None`` for a fixed base.
        base_angular: Size of the angular velocity jump of a floating base, rad/s; ``None`` for a fixed base.
        joint: The worst joint; ``None`` if the robot has no joints.
    """

    base_linear: float | None
    base_angular: float | None
    joint: WorstJoint | None

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return json_block(self)


def tangent_units(robot: Robot) -> tuple[str, ...]:
    """Return ``m/s`` or ``rad/s`` for each of the nv velocity entries."""
    units: list[str] = []
    for index in range(1, robot.model.njoints):
        subspace = joint_kind(robot.model.joints[index], str(robot.model.names[index])).subspace
        units += ["m/s" if np.abs(column[:3]).max() > 0 else "rad/s" for column in subspace.T]
    return tuple(units)


def impact_effect(robot: Robot, velocity: Array) -> ImpactEffect:
    """Return base and worst joint of the velocity jump ``velocity``, shape (nv,)."""
    linear, angular = (float(np.linalg.norm(velocity[part])) for part in (slice(3), slice(3, 6)))
    joint = _worst_joint(robot, np.abs(velocity))
    return ImpactEffect(linear, angular, joint) if robot.floating else ImpactEffect(None, None, joint)


def _worst_joint(robot: Robot, sizes: Array) -> WorstJoint | None:
    first, units = 6 if robot.floating else 0, tangent_units(robot)
    joints = np.arange(first, robot.nv)
    if not joints.size:
        return None
    limits = robot.velocity_limits
    limited = joints[np.isfinite(limits[joints])]
    turning = [k for k in joints.tolist() if units[k] == "rad/s"]
    compared = limited if limited.size else np.array(turning or joints.tolist())
    k = int(compared[np.argmax((sizes / limits if limited.size else sizes)[compared])])
    share = float(sizes[k] / limits[k]) if limited.size else None
    return WorstJoint(robot.tangent_names[k], float(sizes[k]), units[k], share)
