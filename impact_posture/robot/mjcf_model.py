"""Build a ``pin.Model`` from a compiled MJCF (``mujoco.MjModel``).

The Pinocchio configuration ``q`` differs from the MuJoCo ``qpos`` only in two respects.  Quaternions in ``q`` are in
the order x y z w.  A joint without limits has a cosine and a sine in ``q``, like a continuous joint of a URDF.  The
reference position ``ref`` of a joint is part of its placement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.robot.joint_coupling import JointCoupling
from impact_posture.robot.mjcf_file import drives_joint, is_floating, object_name
from impact_posture.robot.model_joints import q_slice
from impact_posture.system.arrays import Array
from impact_posture.system.optional_package import import_mujoco

ROOT_JOINT = "root_joint"
# Limit that Pinocchio sets for cosines, sines and entries of quaternions.
_UNIT = 1.01


def model_of(mjcf: Any, couplings: Sequence[JointCoupling]) -> pin.Model:
    """Return the model of an ``MjModel``: joints, inertias, armature, limits; bodies, joints and sites as frames.

    A body with several joints becomes a chain of joints, in which only the last joint carries the inertia.
    """
    # The coordinate of a coupled joint is the angle itself, because a cosine and a sine do not count full turns.
    whole = {joint for c in couplings for joint in (c.follower, c.leader)}
    types = import_mujoco().mjtJoint
    model = pin.Model()
    model.name = "robot"
    model.gravity = pin.Motion(np.r_[mjcf.opt.gravity, np.zeros(3)])
    # Body → joint that moves it, placement in the axes of this joint, frame.
    bodies: list[tuple[int, pin.SE3, int]] = [(0, pin.SE3.Identity(), 0)]
    if mjcf.body_geomnum[0] and not is_floating(mjcf):
        model.addBodyFrame("world", 0, pin.SE3.Identity(), 0)
    for b in range(1, mjcf.nbody):
        joint, parent, frame = bodies[mjcf.body_parentid[b]]
        at = parent * placement(mjcf.body_pos[b], mjcf.body_quat[b])
        for j in range(mjcf.body_jntadr[b], mjcf.body_jntadr[b] + mjcf.body_jntnum[b]):
            if mjcf.jnt_type[j] == types.mjJNT_FREE:
                joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), ROOT_JOINT)
                at = pin.SE3.Identity()
            else:
                name = object_name(mjcf, "joint", j)
                kind, before, after = _joint(mjcf, j, endless=name not in whole and not mjcf.jnt_limited[j])
                joint = model.addJoint(joint, kind, at * before, name)
                at = after
            frame = model.addJointFrame(joint, frame)
        model.appendBodyToJoint(joint, _inertia(mjcf, b), at)
        frame = model.addBodyFrame(object_name(mjcf, "body", b), joint, at, frame)
        bodies.append((joint, at, frame))
    for s in range(mjcf.nsite):
        joint, at, frame = bodies[mjcf.site_bodyid[s]]
        at = at * placement(mjcf.site_pos[s], mjcf.site_quat[s])
        model.addFrame(pin.Frame(object_name(mjcf, "site", s), joint, frame, at, pin.FrameType.OP_FRAME))
    _set_limits(model, mjcf)
    model.armature = _armature(mjcf)
    return model


def configuration(model: pin.Model, mjcf: Any, entries: Mapping[str, Array] | None = None) -> Array:
    """Return the configuration, shape (nq,), for ``entries``: joint → its entries in ``qpos``.

    Joints that are missing in ``entries`` have their position in ``qpos0``.
    """
    q, ends = np.zeros(model.nq), np.append(mjcf.jnt_qposadr, mjcf.nq)
    for j in range(mjcf.njnt):
        values = mjcf.qpos0[ends[j] : ends[j + 1]]
        values = (entries or {}).get(object_name(mjcf, "joint", j), values)
        if len(values) > 1:
            values = np.r_[values[:-4], values[-3:], values[-4]]
        elif model.nqs[j + 1] == 2:
            values = np.r_[np.cos(values), np.sin(values)]
        q[q_slice(model, j + 1)] = values
    return np.asarray(pin.normalize(model, q))


def _joint(mjcf: Any, j: int, *, endless: bool) -> tuple[pin.JointModel, pin.SE3, pin.SE3]:
    """Return a joint, its placement in its body at ``qpos0``, and the placement of the body in the joint frame."""
    types, axis = import_mujoco().mjtJoint, np.array(mjcf.jnt_axis[j])
    shift = pin.SE3(np.eye(3), np.array(mjcf.jnt_pos[j]))
    if mjcf.jnt_type[j] == types.mjJNT_BALL:
        return pin.JointModelSpherical(), shift, shift.inverse()
    reference = float(mjcf.qpos0[mjcf.jnt_qposadr[j]])
    if mjcf.jnt_type[j] == types.mjJNT_SLIDE:
        family, back = "P", pin.SE3(np.eye(3), -reference * axis)
    else:
        family = "RUB" if endless else "R"
        back = pin.SE3(pin.AngleAxis(-reference, axis).matrix(), np.zeros(3))
    if axis.max() == 1.0:
        kind = getattr(pin, f"JointModel{family}{'XYZ'[int(axis.argmax())]}")()
    elif family == "RUB":
        # Pinocchio has unbounded joints only about coordinate axes, so the joint frame is turned until z is the joint
        # axis.
        turn = pin.SE3(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix(), np.zeros(3))
        return pin.JointModelRUBZ(), shift * back * turn, turn.inverse() * shift.inverse()
    else:
        kind = (pin.JointModelPrismaticUnaligned if family == "P" else pin.JointModelRevoluteUnaligned)(axis)
    return kind, shift * back, shift.inverse()


def placement(position: Array, quaternion: Array) -> pin.SE3:
    """Return a placement from a position, m, and a quaternion w x y z."""
    return pin.SE3(pin.Quaternion(*[float(v) for v in quaternion]).matrix(), np.array(position))


def _inertia(mjcf: Any, b: int) -> pin.Inertia:
    at = placement(mjcf.body_ipos[b], mjcf.body_iquat[b])
    moments = at.rotation @ np.diag(mjcf.body_inertia[b]) @ at.rotation.T
    return pin.Inertia(float(mjcf.body_mass[b]), at.translation, (moments + moments.T) / 2)


def _set_limits(model: pin.Model, mjcf: Any) -> None:
    """Set limits of position and torque; MJCF states no limits of velocity."""
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    effort = np.full(model.nv, np.inf)
    for j, largest in enumerate(_efforts(mjcf)):
        at = q_slice(model, j + 1)
        if model.nqs[j + 1] == 1 and mjcf.jnt_limited[j]:
            lower[at], upper[at] = mjcf.jnt_range[j]
        elif model.nqs[j + 1] > 1:
            at = slice(max(at.start, at.stop - 4), at.stop)
            lower[at], upper[at] = -_UNIT, _UNIT
        if model.nvs[j + 1] == 1:
            effort[model.idx_vs[j + 1]] = largest
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    model.upperEffortLimit = effort


def _efforts(mjcf: Any) -> list[float]:
    """Return the largest torque (N·m) or force (N) of each joint in both directions; infinite if not stated.

    The limits of the actuators of a joint add up, and ``actuatorfrcrange`` limits their sum.
    """
    efforts, drives = [], [a for a in range(mjcf.nu) if drives_joint(mjcf, a) and mjcf.actuator_gear[a, 0]]
    for j in range(mjcf.njnt):
        driving = [a for a in drives if mjcf.actuator_trnid[a, 0] == j]
        effort = sum(_force(mjcf, a) * abs(mjcf.actuator_gear[a, 0]) for a in driving) if driving else np.inf
        if mjcf.jnt_actfrclimited[j]:
            effort = min(effort, _both_ways(mjcf.jnt_actfrcrange[j]))
        efforts.append(float(effort))
    return efforts


def _force(mjcf: Any, a: int) -> float:
    """Return the largest force of an actuator from its range of forces, or the range of controls of a motor."""
    mujoco = import_mujoco()
    limits = [np.inf]
    if mjcf.actuator_forcelimited[a]:
        limits.append(_both_ways(mjcf.actuator_forcerange[a]))
    gain, bias, dynamics = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE
    kinds = mjcf.actuator_gaintype[a], mjcf.actuator_biastype[a], mjcf.actuator_dyntype[a]
    control = mjcf.actuator_ctrladr[a]
    if kinds == (gain, bias, dynamics) and mjcf.actuator_ctrllimited[control]:
        limits.append(_both_ways(mjcf.actuator_ctrlrange[control]) * abs(mjcf.actuator_gainprm[a, 0]))
    return float(min(limits))


def _both_ways(interval: Array) -> float:
    """Return the largest magnitude that a range permits in both directions; infinite for a one-sided range."""
    return float(min(-interval[0], interval[1])) if interval[0] < 0 < interval[1] else np.inf


def _armature(mjcf: Any) -> Array:
    """Return the armature of joints and their actuators, kg·m² (kg), shape (nv,)."""
    armature = np.array(mjcf.dof_armature)
    for a in np.flatnonzero(mjcf.actuator_armature):
        at = mjcf.jnt_dofadr[mjcf.actuator_trnid[a, 0]]
        armature[at] += mjcf.actuator_armature[a] * mjcf.actuator_gear[a, 0] ** 2
    return armature
