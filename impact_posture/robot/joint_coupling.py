"""Coupled joints: a follower moves with its leader, like the fingers of a gripper with one motor.

A configuration contains both joints, and ``q_follower = ratio · q_leader + offset``.  All generalized velocities that
the couplings allow satisfy ``ν = C ν``.  The matrix ``C`` sets the velocity of the follower to the ratio times the
velocity of the leader.  ``C`` is a projector.  The dynamics of the coupled robot have the mass matrix ``CᵀMC`` and
the Jacobian ``JC``.  The motor of the leader exerts ``Cᵀτ``.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.config.text_parsers import finite_numbers
from impact_posture.errors import UrdfError, nearest
from impact_posture.robot.model_joints import ENDLESS
from impact_posture.system.arrays import Array


@dataclass(frozen=True)
class JointCoupling:
    """``q_follower = ratio · q_leader + offset`` for two revolute or prismatic joints, in rad or m."""

    follower: str
    leader: str
    ratio: float
    offset: float


def composed(stated: Mapping[str, JointCoupling], where: str) -> tuple[JointCoupling, ...]:
    """Return equal couplings in which no leader is a follower; the keys of ``stated`` are names of followers.

    Raises:
        UrdfError: Joints follow each other in a circle.
    """
    couplings = []
    for name, coupling in stated.items():
        passed, c = [name, coupling.leader], coupling
        while c.leader in stated:
            by = stated[c.leader]
            c = JointCoupling(name, by.leader, c.ratio * by.ratio, c.offset + c.ratio * by.offset)
            if c.leader in passed:
                circle = " mimics ".join(f"'{joint}'" for joint in [*passed, c.leader])
                raise UrdfError(f"joint {circle}", where=where, hint="remove one coupling")
            passed.append(c.leader)
        couplings.append(c)
    return tuple(couplings)


def urdf_couplings(root: ET.Element, where: str) -> tuple[tuple[JointCoupling, ...], list[str]]:
    """Return the couplings that ``<mimic>`` tags of a URDF state, and warnings about tags that state no coupling.

    The function changes the tags of coupled joints in ``root``.  Continuous joints become revolute joints without
    limits, because a cosine and a sine do not count the full turns of a leader.  The limits of a joint become equal
    if it mimics a fixed joint, or if the multiplier is zero.

    Raises:
        UrdfError: Joints mimic each other in a circle, a planar or floating joint is coupled, or a number is invalid.
    """
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    stated, warnings = dict[str, JointCoupling](), []
    for name, joint in joints.items():
        tag = joint.find("mimic")
        if tag is None or joint.get("type") == "fixed":
            continue
        leader = tag.get("joint", "")
        if leader not in joints:
            fault = f"joint '{name}' mimics '{leader}', which is not a joint of the URDF"
            near = nearest(leader, joints, 1)[0]
            warnings.append(f"{fault} (did you mean {near}?): it moves by itself; correct its <mimic>")
            continue
        ratio, offset = (_number(tag, key, value, where) for key, value in (("multiplier", "1"), ("offset", "0")))
        if ratio and joints[leader].get("type") != "fixed":
            stated[name] = JointCoupling(name, leader, ratio, offset)
        else:
            _set_limits(joint, offset, offset)
    couplings = composed(stated, where)
    for c in couplings:
        for joint in (joints[c.follower], joints[c.leader]):
            kind = joint.get("type")
            if kind == "continuous":
                _set_limits(joint, -2 * ENDLESS, 2 * ENDLESS)
            elif kind not in ("revolute", "prismatic"):
                fault = f"joint '{joint.get('name')}' of type {kind} is coupled by <mimic>"
                raise UrdfError(fault, where=where, hint="couple only revolute, prismatic and continuous joints")
    return couplings, warnings


def _number(tag: ET.Element, key: str, default: str, where: str) -> float:
    if not (numbers := finite_numbers(tag.get(key, default))):
        fault = f"<mimic joint='{tag.get('joint')}'>: {key} '{tag.get(key)}' is not a number"
        raise UrdfError(fault, where=where, hint="correct it")
    return numbers[0]


def _set_limits(joint: ET.Element, low: float, high: float) -> None:
    limit = joint.find("limit")
    limit = ET.SubElement(joint, "limit", effort="0", velocity="0") if limit is None else limit
    limit.attrib |= {"lower": str(low), "upper": str(high)}
    if joint.get("type") == "continuous":
        joint.set("type", "revolute")


def present(couplings: Iterable[JointCoupling], model: pin.Model) -> tuple[JointCoupling, ...]:
    """Return the couplings whose joints both exist in a model."""
    return tuple(c for c in couplings if model.existJointName(c.follower) and model.existJointName(c.leader))


def with_partners(couplings: Iterable[JointCoupling], joints: Collection[str]) -> tuple[str, ...]:
    """Return ``joints`` and all joints that are coupled to them."""
    chosen = dict.fromkeys(joints)
    leaders = {c.leader for c in couplings if chosen.keys() & {c.follower, c.leader}}
    partners = (joint for c in couplings if c.leader in leaders for joint in (c.leader, c.follower))
    return tuple(dict.fromkeys((*chosen, *partners)))


def couple_limits(model: pin.Model, couplings: Iterable[JointCoupling]) -> list[str]:
    """Let position and velocity limits of followers bound their leaders; return warnings.

    Equal limits of a follower are treated as missing limits.
    """
    warnings = []
    low, high = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    speed = model.upperVelocityLimit.copy()
    couplings = tuple(couplings)
    for c in couplings:
        f, lead = _in_q(model, c.follower), _in_q(model, c.leader)
        if low[f] < high[f] and low[lead] < high[lead]:
            ends = sorted((bound - c.offset) / c.ratio for bound in (low[f], high[f]))
            if max(low[lead], ends[0]) < min(high[lead], ends[1]):
                low[lead], high[lead] = max(low[lead], ends[0]), min(high[lead], ends[1])
            else:
                stated, other = f"[{low[f]:g}, {high[f]:g}]", f"[{low[lead]:g}, {high[lead]:g}]"
                fault = f"the position limits {stated} of '{c.follower}' contradict the limits {other} of its leader"
                warnings.append(f"{fault} '{c.leader}', so the limits of '{c.follower}' are not used")
        f, lead = _in_v(model, c.follower), _in_v(model, c.leader)
        if 0 < speed[f] < ENDLESS:
            limit = speed[f] / abs(c.ratio)
            speed[lead] = min(speed[lead], limit) if speed[lead] > 0 else limit
    # Pinocchio writes "no limit" as the largest double, so a product may overflow to infinity.
    with np.errstate(over="ignore"):
        for c in couplings:
            f, lead = _in_q(model, c.follower), _in_q(model, c.leader)
            low[f], high[f] = sorted(c.ratio * bound + c.offset for bound in (low[lead], high[lead]))
            speed[_in_v(model, c.follower)] = abs(c.ratio) * speed[_in_v(model, c.leader)]
    model.lowerPositionLimit, model.upperPositionLimit = low, high
    model.upperVelocityLimit = speed
    return warnings


def coupled_entries(model: pin.Model, couplings: Iterable[JointCoupling]) -> list[tuple[int, int, float]]:
    """Return (entry of the follower in ν, entry of the leader, ratio) of each coupling."""
    return [(_in_v(model, c.follower), _in_v(model, c.leader), c.ratio) for c in couplings]


def coupled(model: pin.Model, couplings: Sequence[JointCoupling], q: Array) -> Array:
    """Return a copy of ``q``, shape (nq,), with each follower at the position that its leader requires."""
    q = np.array(q, dtype=float)
    for c in couplings:
        q[_in_q(model, c.follower)] = c.ratio * q[_in_q(model, c.leader)] + c.offset
    return q


def _in_q(model: pin.Model, joint: str) -> int:
    return int(model.idx_qs[model.getJointId(joint)])


def _in_v(model: pin.Model, joint: str) -> int:
    return int(model.idx_vs[model.getJointId(joint)])
