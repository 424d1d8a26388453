"""Armature: where it comes from, and a word when there is none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.errors import InputError, SpecError
from impact_posture.robot.spec import RobotSpec
from impact_posture.robot.urdf import joint_index
from impact_posture.tables import read_toml

Vector = NDArray[np.float64]

ArmatureOption = Mapping[str, float] | str | None


def set_armature(model: pin.Model, spec: RobotSpec, srdf: Path | None, option: ArmatureOption, name: str) -> str:
    """Set ``model.armature``, kg·m² (kg for prismatic joints).

    First of: the option, robot.toml, rotor data of the SRDF, zero.

    Returns:
        Where the values came from, in words.

    Raises:
        InputError: A joint that does not exist, a value below zero, or an unreadable file.
    """
    if option == "none":
        model.armature = np.zeros(model.nv)
        return "none (given)"
    armature, source = np.array(model.armature, dtype=float), "none"
    if spec.armature.default is not None or spec.armature.joints:
        armature = _armature_vector(model, spec.armature.default or 0.0, spec.armature.joints, name)
        source = f"robot.toml ({spec.armature.source})" if spec.armature.source else "robot.toml"
    elif srdf is not None and "rotor_params" in srdf.read_text(encoding="utf-8", errors="replace"):
        pin.loadRotorParameters(model, str(srdf), False)
        armature = np.array(model.armature, dtype=float)
        armature[: _base_width(model)] = 0.0
        source = "rotor data in the SRDF"
    if isinstance(option, str):
        armature = _armature_vector(model, 0.0, _armature_file(Path(option)), option)
        source = option
    elif option:
        for joint, value in option.items():
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"armature {joint}={value:g}", where="armature", hint="give a number ≥ 0")
            index = joint_index(model, joint, "armature")
            armature[model.idx_vs[index] : model.idx_vs[index] + model.nvs[index]] = value
        source = f"given values over {source}"
    model.armature = armature
    return source


def _armature_file(path: Path) -> dict[str, float]:
    data = read_toml(path)
    table = data.get("armature", data)
    values = table.get("joints", table) if isinstance(table, dict) else {}
    try:
        return {str(k): float(v) for k, v in values.items()}
    except (TypeError, ValueError):
        raise SpecError("holds no table joint = value", where=str(path), hint="write: joint_name = 0.01") from None


def _armature_vector(model: pin.Model, default: float, joints: Mapping[str, float], where: str) -> Vector:
    armature = np.full(model.nv, default)
    armature[: _base_width(model)] = 0.0
    for joint, value in joints.items():
        index = joint_index(model, joint, f"{where} [armature]")
        if not (np.isfinite(value) and value >= 0):
            raise SpecError(f"armature of '{joint}' is {value:g}", where=where, hint="give a number ≥ 0")
        armature[model.idx_vs[index] : model.idx_vs[index] + model.nvs[index]] = value
    return armature


def _base_width(model: pin.Model) -> int:
    return 6 if model.njoints > 1 and model.joints[1].shortname() == "JointModelFreeFlyer" else 0


def armature_warning(model: pin.Model, source: str, held: Sequence[str] = ()) -> tuple[str, ...]:
    """Return one line where joints have no armature, else nothing; joints that are held by default do not count."""
    first = 2 if _base_width(model) else 1
    armature = np.asarray(model.armature)
    joints = [str(model.names[i]) for i in range(first, model.njoints)]
    bare = [
        name
        for i, name in enumerate(joints, first)
        if name not in held and not (armature[model.idx_vs[i] : model.idx_vs[i] + model.nvs[i]] > 0).any()
    ]
    if not bare:
        return ()
    which = "" if len(bare) == len([j for j in joints if j not in held]) else f" at {_listed(bare)}"
    return (
        f"armature is zero{which} ({source}): geared motors usually have some, and H scales like 1/armature² "
        "where it dominates; give `armature` or robot.toml [armature]",
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
