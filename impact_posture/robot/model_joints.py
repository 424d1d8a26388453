"""Joints of a ``pin.Model``: their names and indices, and their entries in ``q`` and ``ν``."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.errors import JointNotFound

# Limits beyond this are no limits.  Pinocchio writes "no limit" as the largest double.
ENDLESS = 1e10


def is_free_flyer(model: pin.Model) -> bool:
    """Return whether the first joint of a model is a free-flyer."""
    return bool(model.njoints > 1 and model.joints[1].shortname() == "JointModelFreeFlyer")


def joint_range(model: pin.Model) -> range:
    """Return the indices of all joints except the universe and the free-flyer."""
    return range(2 if is_free_flyer(model) else 1, model.njoints)


def q_slice(model: pin.Model, index: int) -> slice:
    """Return the entries of a joint in ``q``."""
    return slice(int(model.idx_qs[index]), int(model.idx_qs[index] + model.nqs[index]))


def v_slice(model: pin.Model, index: int) -> slice:
    """Return the entries of a joint in ``ν``."""
    return slice(int(model.idx_vs[index]), int(model.idx_vs[index] + model.nvs[index]))


def scalar_entries(model: pin.Model, index: int, value: float) -> tuple[float, ...]:
    """Return the entries in ``q`` of a joint with one degree of freedom: its value, or its cosine and sine."""
    return (value,) if model.nqs[index] == 1 else (math.cos(value), math.sin(value))


def joint_index(model: pin.Model, joint: str, where: str) -> int:
    """Return the index of a movable joint; raise ``JointNotFound`` for any other name."""
    known = movable_joints(model)
    if joint not in known:
        raise JointNotFound(joint, known, where=where)
    return int(model.getJointId(joint))


def movable_joints(model: pin.Model) -> list[str]:
    """Return the names of all joints except the universe and the root joint."""
    return [str(name) for name in model.names if name not in ("universe", "root_joint")]


def immovable_joints(model: pin.Model) -> list[str]:
    """Return the names of the joints whose position limits are equal."""
    scalar = [index for index in joint_range(model) if model.nqs[index] == 1]
    at = [int(model.idx_qs[index]) for index in scalar]
    equal = model.lowerPositionLimit[at] == model.upperPositionLimit[at]
    return [str(model.names[index]) for index, same in zip(scalar, equal, strict=True) if same]


def rigid_groups(model: pin.Model, held: Sequence[str]) -> list[int]:
    """Return the group number of each joint; links of one group are one body if the joints ``held`` do not move."""
    group = list(range(model.njoints))
    for joint in range(1, model.njoints):
        if model.names[joint] in held:
            group[joint] = group[int(model.parents[joint])]
    return group


def finite_armature(model: pin.Model) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the armature with zeros at locked joints, and whether each velocity entry is locked, shape (nv,) each.

    An infinite armature locks a joint in an impact: its velocity does not change, whatever the impulse.
    """
    armature = np.array(model.armature, dtype=float)
    locked = np.isinf(armature)
    return np.where(locked, 0.0, armature), locked
