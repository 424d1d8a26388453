"""Named postures of a model: from its SRDF, from ``robot.toml``, and the neutral posture."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.errors import SpecError, UrdfError
from impact_posture.robot.model_joints import is_free_flyer, joint_index, q_slice, scalar_entries
from impact_posture.robot.robot_description import RobotDescription
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.robot.urdf import read_srdf
from impact_posture.system.arrays import Array


def named_postures(
    described: RobotDescription, srdf: Path | None, spec: RobotSpec, name: str
) -> tuple[dict[str, Array], str]:
    """Return all named postures, shape (nq,) each, and the name of the default posture.

    Postures of ``robot.toml`` (``spec``) replace keyframes of the MJCF and ``group_state`` tags of the SRDF with the
    same name.  Before the call, the limits of the model must be set.

    Raises:
        UrdfError: The SRDF cannot be read.
        SpecError: A posture of ``robot.toml`` does not fit the model, or the default posture does not exist.
    """
    states = {**described.postures, **_srdf_postures(described.model, srdf)}
    kept = {key: q for key, q in states.items() if key not in spec.postures}
    postures = kept | _toml_postures(described, spec, name)
    default = spec.default_posture or next(iter(postures), "neutral")
    postures.setdefault("neutral", _neutral(described))
    if default not in postures:
        fault = f"default_posture '{default}' does not exist"
        raise SpecError(fault, where=name, hint=f"choose one of {', '.join(postures)}")
    return postures, default


def states_with_base(srdf: Path | None) -> list[str]:
    """Return the names of the ``group_state`` tags of an SRDF with a base pose (a joint with seven numbers)."""
    states = read_srdf(srdf).iter("group_state") if srdf is not None else ()
    return [
        str(state.get("name"))
        for state in states
        if any(len((joint.get("value") or "").split()) == 7 for joint in state.iter("joint"))
    ]


def ignored_bases(spec: RobotSpec, srdf: Path | None, default: str) -> tuple[str, ...]:
    """Return a warning if postures of a robot with a fixed root have base poses, which are ignored."""
    named = [key for key, posture in spec.postures.items() if posture.base is not None] + states_with_base(srdf)
    if not named:
        return ()
    which = default if default in named else ", ".join(dict.fromkeys(named))
    return (
        f"the root is fixed, so the base pose of posture {which} is left out, and the root link sits at the world's "
        "origin along its axes; `root` free-flyer keeps the pose",
    )


def _neutral(described: RobotDescription) -> Array:
    """Return the neutral configuration of a file, with each value beyond a limit replaced by this limit."""
    model = described.model
    return np.asarray(np.clip(described.neutral, model.lowerPositionLimit, model.upperPositionLimit))


def _srdf_postures(model: pin.Model, srdf: Path | None) -> dict[str, Array]:
    if srdf is None:
        return {}
    root = read_srdf(srdf)
    try:
        pin.loadReferenceConfigurationsFromXML(model, ET.tostring(root, "unicode"), False)
    except Exception as error:  # The XML library of Pinocchio may raise any exception.
        raise UrdfError(f"is not an SRDF ({error})", where=str(srdf), hint="correct the SRDF") from None
    states = model.referenceConfigurations
    return {item.key(): pin.normalize(model, np.array(item.data(), dtype=float)) for item in states}


def _toml_postures(described: RobotDescription, spec: RobotSpec, name: str) -> dict[str, Array]:
    model, floating, result = described.model, is_free_flyer(described.model), {}
    for key, posture in spec.postures.items():
        where = f"{name} posture '{key}'"
        q = _neutral(described)
        if posture.base is not None and spec.model.root != "free-flyer" and not floating:
            fault = f"posture '{key}' gives a base pose, but the root is fixed"
            raise SpecError(fault, where=name, hint='remove it, or write root = "free-flyer" in [model]')
        # If the user fixes a floating robot to the world, base poses are ignored, and ignored_bases warns.
        if posture.base is not None and floating:
            norm = float(np.linalg.norm(posture.base[3:]))
            if not (np.isfinite(posture.base).all() and abs(norm - 1) < 1e-3):
                fault = f"base quaternion of norm {norm:.4g}"
                raise SpecError(fault, where=where, hint="give a unit quaternion x y z w")
            q[:7] = posture.base
        for joint, value in posture.joints.items():
            index = joint_index(model, joint, where)
            if model.nvs[index] != 1:
                fault = f"posture '{key}': joint '{joint}' has {model.nvs[index]} degrees of freedom, not one number"
                raise SpecError(fault, where=name, hint="give the posture in an SRDF")
            if not np.isfinite(value):
                raise SpecError(f"posture '{key}': joint '{joint}' is {value}", where=name, hint="give a number")
            q[q_slice(model, index)] = scalar_entries(model, index, value, where)
        result[key] = np.asarray(pin.normalize(model, q))
    return result
