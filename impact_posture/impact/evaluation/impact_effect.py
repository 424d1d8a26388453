"""Effect of a velocity jump on the robot: the jump of the base, and the jump of the joint nearest to its limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.dynamics.joints import joint_kind
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class WorstJoint(JsonBlock):
    """The joint with the largest ratio of velocity jump to velocity limit.

    Attributes:
        velocity: Size of the velocity jump of this joint, in ``unit``.
        unit: ``rad/s`` or ``m/s``.
        share: Velocity jump divided by the velocity limit of this joint; ``None`` if no joint has a limit.  Without
            limits, the worst joint is the joint with the largest jump in rad/s, or in m/s if no joint turns.
    """

    name: str
    velocity: float
    unit: str
    share: float | None


@dataclass(frozen=True)
class ImpactEffect(JsonBlock):
    """Effect of a velocity jump on the base and on the worst joint.

    Attributes:
        base_linear: Size of the linear velocity jump of a floating base, m/s; ``None`` for a fixed base.
        base_angular: Size of the angular velocity jump of a floating base, rad/s; ``None`` for a fixed base.
        joint: The worst joint; ``None`` if the robot has no joints.
    """

    base_linear: float | None
    base_angular: float | None
    joint: WorstJoint | None


@dataclass(frozen=True)
class ImpactLoad(ImpactEffect):
    """Effects of an impact on base, joints and contact, as predicted or as measured.

    Attributes:
        impulse: Normal impulse at the first contact, N·s.
        peak_force: Largest normal force, N; ``None`` if it is unknown, or for several contacts.
        jump: Norm ``‖Δν‖_W`` of the jump of base and joints, with the weight matrix ``W`` of the metric.
    """

    impulse: float
    peak_force: float | None
    jump: float


def tangent_units(robot: Robot) -> tuple[str, ...]:
    """Return ``m/s`` or ``rad/s`` for each of the nv velocity entries."""
    units: list[str] = []
    for index in range(1, robot.model.njoints):
        subspace = joint_kind(robot.model.joints[index], str(robot.model.names[index])).subspace
        units += ["m/s" if np.abs(column[:3]).max() > 0 else "rad/s" for column in subspace.T]
    return tuple(units)


def impact_effect(robot: Robot, velocity: Array) -> ImpactEffect:
    """Return base and worst joint of the velocity jump ``velocity``, shape (nv,).

    For several velocity jumps, shape (n, nv), return the largest size of each quantity over all jumps.
    """
    jumps = np.atleast_2d(velocity)
    linear, angular = (float(np.linalg.norm(jumps[:, part], axis=1).max()) for part in (slice(3), slice(3, 6)))
    joint = _worst_joint(robot, np.abs(jumps).max(axis=0))
    return ImpactEffect(linear, angular, joint) if robot.floating else ImpactEffect(None, None, joint)


def _worst_joint(robot: Robot, sizes: Array) -> WorstJoint | None:
    first, units = robot.first_joint, tangent_units(robot)
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


def mean_load(loads: Sequence[ImpactLoad]) -> ImpactLoad:
    """Return the means of base, impulse and jump over all impacts, the worst joint and the largest peak force."""

    def mean(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if len(known) == len(values) else None

    forces = [load.peak_force for load in loads if load.peak_force is not None]
    return ImpactLoad(
        mean([load.base_linear for load in loads]),
        mean([load.base_angular for load in loads]),
        worst_joint([load.joint for load in loads]),
        float(np.mean([load.impulse for load in loads])),
        max(forces) if len(forces) == len(loads) else None,
        float(np.mean([load.jump for load in loads])),
    )


def worst_joint(joints: Sequence[WorstJoint | None]) -> WorstJoint | None:
    """Return the worst joint of several impacts: the largest share, or the largest jump if no joint has a limit."""
    known = [joint for joint in joints if joint is not None]
    return max(known, key=lambda joint: joint.velocity if joint.share is None else joint.share, default=None)
