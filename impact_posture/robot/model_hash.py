"""Hashes of a model that are the same on every machine."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from impact_posture.robot.joint_coupling import JointCoupling
from impact_posture.system.arrays import Array

# Smaller numbers in rotation matrices and inertias (SI units) are treated as zero.
_ROUNDING = 1e-14


def dynamics_hash(model: pin.Model, armature: Array, couplings: Sequence[JointCoupling]) -> str:
    """Return the hash of joints, placements, inertias, couplings and ``armature``, shape (nv,)."""
    joints = []
    for i in range(1, model.njoints):
        arrays = model.jointPlacements[i].homogeneous, model.inertias[i].matrix(), _axis(model.joints[i])
        numbers = [number for array in arrays for number in rounded(array)]
        joints.append([str(model.names[i]), str(model.joints[i].shortname()), int(model.parents[i]), *numbers])
    return hash_of([joints, rounded(armature), *map(str, couplings)])


def kinematics_hash(
    model: pin.Model, postures: Mapping[str, Array], default: str, couplings: Sequence[JointCoupling]
) -> str:
    """Return the hash of joints, frames, position limits, couplings, postures and the name of the default posture."""
    placed = [(f.name, int(f.parentJoint), rounded(f.placement.homogeneous)) for f in model.frames]
    for k in range(1, model.njoints):
        joint, numbers = model.joints[k], model.jointPlacements[k].homogeneous
        placed.append((joint.shortname(), int(model.parents[k]), rounded([*numbers.flat, *_axis(joint)])))
    arrays = model.lowerPositionLimit, model.upperPositionLimit, *postures.values()
    return hash_of((placed, [rounded(values) for values in arrays], default, *map(str, couplings)))


def hash_of(content: object) -> str:
    """Return the SHA-256 of a value as JSON."""
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def rounded(values: object) -> list[str]:
    """Return numbers as text with 12 digits; numbers up to 1e-14 become zero."""
    return [f"{v:.12g}" if abs(v) > _ROUNDING else "0" for v in map(float, np.asarray(values).reshape(-1))]


def _axis(joint: pin.JointModel) -> Array:
    """Return the motion subspace of a joint, which contains the axis, at the neutral configuration."""
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), "joint")
    # Use a model with this joint alone, because the joint reads its entries of the configuration by index.
    copy = model.joints[1]
    data = copy.createData()
    copy.calc(data, pin.neutral(model))
    return np.asarray(data.S).reshape(-1)
