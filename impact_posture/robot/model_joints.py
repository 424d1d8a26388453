"""Joints of a ``pin.Model``: their names and indices, and their entries in ``q`` and ``ν``."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.errors import JointNotFound, PostureError, degrees_hint

# A position limit larger than this value is treated as missing.  Pinocchio writes "no limit" as the largest double.
ENDLESS = 1e10


# Name of a Pinocchio joint type, without "JointModel" → family of the joint.
_FAMILIES = {
    **dict.fromkeys(("RX", "RY", "RZ", "RevoluteUnaligned"), "revolute"),
    **dict.fromkeys(("RUBX", "RUBY", "RUBZ", "RevoluteUnboundedUnaligned"), "continuous"),
    **dict.fromkeys(("PX", "PY", "PZ", "PrismaticUnaligned"), "prismatic"),
    **{"FreeFlyer": "free-flyer", "Planar": "planar", "Spherical": "spherical", "Translation": "translation"},
}
# Family → names and units of its entries in ``q``.
JOINT_ENTRIES = {
    "revolute": ("(rad)",),
    "continuous": ("cos", "sin"),
    "prismatic": ("(m)",),
    "free-flyer": ("x (m)", "y (m)", "z (m)", "qx", "qy", "qz", "qw"),
    "planar": ("x (m)", "y (m)", "cos", "sin"),
    "spherical": ("qx", "qy", "qz", "qw"),
    "translation": ("x (m)", "y (m)", "z (m)"),
}


def joint_family(joint: pin.JointModel) -> str:
    """Return the family of a joint (a key of :data:`JOINT_ENTRIES`); for other joints, the name of the type."""
    short = str(joint.shortname()).removeprefix("JointModel")
    return _FAMILIES.get(short, short)


def effort_unit(model: pin.Model, index: int) -> str:
    """Return the unit of the effort of a joint: N for a prismatic joint, N·m for all others."""
    return "N" if joint_family(model.joints[index]) == "prismatic" else "N·m"


def is_free_flyer(model: pin.Model) -> bool:
    """Return whether the first joint of a model is a free-flyer."""
    return bool(model.njoints > 1 and model.joints[1].shortname() == "JointModelFreeFlyer")


def is_link(frame: pin.Frame) -> bool:
    """Return whether a frame is a link of a URDF, or a body or site of an MJCF, and not the frame of a joint."""
    return bool(frame.type in (pin.FrameType.BODY, pin.FrameType.OP_FRAME))


def joint_range(model: pin.Model) -> range:
    """Return the indices of all joints except the universe and the free-flyer."""
    return range(2 if is_free_flyer(model) else 1, model.njoints)


def q_slice(model: pin.Model, index: int) -> slice:
    """Return the entries of a joint in ``q``."""
    return slice(int(model.idx_qs[index]), int(model.idx_qs[index] + model.nqs[index]))


def v_slice(model: pin.Model, index: int) -> slice:
    """Return the entries of a joint in ``ν``."""
    return slice(int(model.idx_vs[index]), int(model.idx_vs[index] + model.nvs[index]))


def scalar_entries(model: pin.Model, index: int, value: float, where: str) -> tuple[float, ...]:
    """Return the entries in ``q`` of a joint with one degree of freedom: its value, or its cosine and sine.

    Raises:
        PostureError: The value of a continuous joint is a whole number beyond two turns, so it is probably in
            degrees.
    """
    if model.nqs[index] == 1:
        return (value,)
    if abs(value) > 4 * math.pi and value == round(value):
        raise PostureError(f"joint '{model.names[index]}' is at {value:g}", where=where, hint=degrees_hint(value))
    return math.cos(value), math.sin(value)


def scalar_value(model: pin.Model, index: int, q: NDArray[np.float64]) -> float:
    """Return the value of a joint with one degree of freedom at ``q``; inverse of :func:`scalar_entries`."""
    entries = q[q_slice(model, index)]
    return float(entries[0] if entries.size == 1 else math.atan2(entries[1], entries[0]))


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
    """Number the joints so that links with equal numbers form a rigid body if the ``held`` joints rest."""
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
