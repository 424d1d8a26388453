"""Joint types and attributes of a URDF that the parser of Pinocchio reads wrongly or drops without a message."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.config.text_parsers import finite_numbers
from impact_posture.errors import UrdfError, listed
from impact_posture.system.arrays import Array

# Types of joints that have an axis.
_WITH_AXIS = ("revolute", "continuous", "prismatic", "planar")
# If the stated range of a continuous joint is shorter than a turn by more than this value, rad, warn that the joint
# should be revolute.
_SHORT_OF_A_TURN = 0.01


def clear_negative_limits(root: ET.Element) -> tuple[str, ...]:
    """Set negative limits of effort and velocity, which Pinocchio rejects, to 0 (not known); return warnings."""
    warnings = []
    for key in ("effort", "velocity"):
        negative = [
            (limit, f"{joint.get('name')} ({limit.get(key)})")
            for joint in root.findall("joint")
            for limit in joint.findall("limit")
            if (limit.get(key) or "").lstrip().startswith("-") and limit.get(key, "").strip("-0. ")
        ]
        for limit, _ in negative:
            limit.set(key, "0")
        if negative:
            fault = f"negative {key} limits are read as not known: {listed([text for _, text in negative])}"
            warnings.append(f"{fault}; state them in robot.toml [limits.{key}]")
    return tuple(warnings)


def correct_joints(root: ET.Element, model: pin.Model, path: Path) -> tuple[str, ...]:
    """Turn the planar joints of a model to their axes; return warnings about joints of the URDF.

    Raises:
        UrdfError: The axis of a joint is zero.  Pinocchio then builds a joint that cannot move.
    """
    warnings = []
    for joint in root.findall("joint"):
        name, kind, tag = joint.get("name", ""), joint.get("type"), joint.find("axis")
        if kind not in _WITH_AXIS or not model.existJointName(name):
            continue
        axis = None if tag is None else np.array([float(v) for v in tag.get("xyz", "0 0 0").split()])
        if axis is not None and not axis.any():
            raise UrdfError(
                f"the axis of joint '{name}' is zero", where=str(path), hint="give the <axis> a direction"
            )
        if kind == "planar" and axis is None:
            default = "the URDF standard would make the normal the x axis"
            warnings.append(f"planar joint '{name}' has no <axis>, so it moves in its x-y plane; {default}")
        elif kind == "planar" and axis is not None:
            _turn_planar(model, int(model.getJointId(name)), axis)
        elif kind == "continuous" and (limits := _short_range(joint)):
            fault = f"joint '{name}' is continuous, so its position limits {limits} have no effect"
            warnings.append(f"{fault}; make its type revolute, or remove them")
    return tuple(warnings)


def _turn_planar(model: pin.Model, index: int, axis: Array) -> None:
    """Make ``axis`` (link axes) the normal of a planar joint; the planar joint of Pinocchio has the normal z.

    The joint frame is turned by the smallest rotation R from z to the axis.  The link and its frames are turned back,
    so that they stay where the URDF places them.
    """
    turn = pin.SE3(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix(), np.zeros(3))
    back = turn.inverse()
    model.jointPlacements[index] = model.jointPlacements[index] * turn
    model.inertias[index] = back.act(model.inertias[index])
    for child in model.children[index]:
        model.jointPlacements[child] = back * model.jointPlacements[child]
    for frame in model.frames:
        if frame.parentJoint == index:
            frame.placement = back * frame.placement


def _short_range(joint: ET.Element) -> str:
    """Return the position range of a joint as text if the range is shorter than a turn; else an empty text."""
    limit = joint.find("limit")
    stated = "" if limit is None else f"{limit.get('lower', '')} {limit.get('upper', '')}"
    low, high = finite_numbers(stated, 2) or (0.0, 0.0)
    return f"[{low:g}, {high:g}]" if 0 < high - low < 2 * math.pi - _SHORT_OF_A_TURN else ""
