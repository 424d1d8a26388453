"""Armature of a model: its sources, and a warning about joints without armature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.config.table_validation import read_toml
from impact_posture.errors import InputError, SpecError, listed
from impact_posture.robot.model_joints import is_free_flyer, joint_index, joint_range, v_slice
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.system.arrays import Array
from impact_posture.system.text_files import read_bytes

ArmatureOption = Mapping[str, float] | str | None


def set_armature(model: pin.Model, spec: RobotSpec, srdf: Path | None, option: ArmatureOption, name: str) -> str:
    """Set ``model.armature``, kg·m² (kg for prismatic joints); return a description of the source of the values.

    The first available source is used: the option, robot.toml, the rotor data of the SRDF, the MJCF, or zero.

    Raises:
        InputError: A joint does not exist, a value is below zero, or a file cannot be read.
    """
    if option == "none":
        model.armature = np.zeros(model.nv)
        return "none (given)"
    armature = np.array(model.armature, dtype=float)
    source = "MJCF" if armature.any() else "none"
    if spec.armature.default is not None or spec.armature.joints:
        armature[:] = spec.armature.default or 0.0
        _set_joints(model, armature, spec.armature.joints, f"{name} [armature]")
        source = f"robot.toml ({spec.armature.source})" if spec.armature.source else "robot.toml"
    elif srdf is not None and b"rotor_params" in read_bytes(srdf):
        pin.loadRotorParameters(model, str(srdf), False)
        armature = np.array(model.armature, dtype=float)
        source = "rotor data in the SRDF"
    if isinstance(option, str):
        armature[:] = 0.0
        _set_joints(model, armature, _armature_file(Path(option)), f"{option} [armature]")
        source = option
    elif option:
        _set_joints(model, armature, option, "armature", InputError)
        source = f"given values over {source}" if source != "none" else "given values"
    if is_free_flyer(model):
        armature[:6] = 0.0
    model.armature = armature
    return source


def armature_warning(model: pin.Model, source: str, held: Sequence[str]) -> tuple[str, ...]:
    """Return a warning about joints without armature, except the joints ``held``; empty if there are none."""
    armature = np.asarray(model.armature)
    counted = {i: str(model.names[i]) for i in joint_range(model) if model.names[i] not in held}
    bare = [name for i, name in counted.items() if not (armature[v_slice(model, i)] > 0).any()]
    if not bare:
        return ()
    which = "" if len(bare) == len(counted) else f" at {listed(bare, 3)}"
    origin = "" if source == "none" else f" ({source})"
    return (
        f"armature is zero{which}{origin}. Geared motors usually have armature, and H scales like "
        "1/armature² where armature dominates; give `armature` or robot.toml [armature]",
    )


def _armature_file(path: Path) -> dict[str, float]:
    data = read_toml(path)
    table = data.get("armature", data)
    values = table.get("joints", table) if isinstance(table, dict) else {}
    try:
        return {str(k): float(v) for k, v in values.items()}
    except (TypeError, ValueError, OverflowError):
        raise SpecError("has no table joint = value", where=str(path), hint="write: joint_name = 0.01") from None


def _set_joints(
    model: pin.Model, armature: Array, values: Mapping[str, float], where: str, error: type[InputError] = SpecError
) -> None:
    for joint, value in values.items():
        if joint == "default" and not model.existJointName(joint):
            hint = "give JOINT=VALUE; for all joints, set [armature] default in robot.toml"
            raise error("'default' is not a joint", where=where, hint=hint)
        index = joint_index(model, joint, where)
        if not (np.isfinite(value) and value >= 0):
            raise error(f"armature of '{joint}' is {value:g}", where=where, hint="give a number ≥ 0")
        armature[v_slice(model, index)] = value
