"""Hashes of a model that are the same on every machine."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from impact_posture.system.arrays import Array

# Rounding error of a zero in a rotation matrix or an inertia (SI units).
_ROUNDING = 1e-14


def dynamics_hash(model: pin.Model, armature: Array) -> str:
    """Return the hash of joints, placements, inertias and an armature, shape (nv,)."""
    joints = []
    for i in range(1, model.njoints):
        arrays = model.jointPlacements[i].homogeneous, model.inertias[i].matrix(), _axis(model.joints[i])
        numbers = [number for array in arrays for number in rounded(array)]
        joints.append([str(model.names[i]), str(model.joints[i].shortname()), int(model.parents[i]), *numbers])
    return hash_of([joints, rounded(armature)])


def kinematics_hash(model: pin.Model, postures: Mapping[str, Array], default: str) -> str:
    """Return the hash of joints, frames, position limits, named postures and the name of the default posture."""
    placed = [(f.name, int(f.parentJoint), rounded(f.placement.homogeneous)) for f in model.frames]
    for k in range(1, model.njoints):
        joint, numbers = model.joints[k], model.jointPlacements[k].homogeneous
        placed.append((joint.shortname(), int(model.parents[k]), rounded([*numbers.flat, *_axis(joint)])))
    arrays = model.lowerPositionLimit, model.upperPositionLimit, *postures.values()
    return hash_of((placed, [rounded(values) for values in arrays], default))


def hash_of(content: object) -> str:
    """Return the SHA-256 of content that JSON can hold."""
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def rounded(values: object) -> list[str]:
    """Return numbers to 12 digits as text, with zero for rounding errors."""
    return [f"{v:.12g}" if abs(v) > _ROUNDING else "0" for v in map(float, np.asarray(values).reshape(-1))]


def _axis(joint: pin.JointModel) -> Array:
    """Return the motion subspace of a joint at the identity, which distinguishes two unaligned joints."""
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), "joint")
    # A copy in a model of its own, because the joint would read other entries of a configuration.
    copy = model.joints[1]
    data = copy.createData()
    copy.calc(data, pin.neutral(model))
    return np.asarray(data.S).reshape(-1)
