"""Read the file that describes a robot: a URDF, or an MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pinocchio as pin

from impact_posture.config.problem_settings import Root
from impact_posture.robot.joint_coupling import JointCoupling, present
from impact_posture.robot.mjcf_file import is_mjcf, read_mjcf
from impact_posture.robot.mjcf_model import configuration, model_of
from impact_posture.robot.urdf import build_model
from impact_posture.system.arrays import Array


class RobotDescription(NamedTuple):
    """A robot as its URDF or MJCF describes it.

    Attributes:
        model: Model with all joints.
        neutral: Values of the joints that a named posture leaves out: zero for a URDF, ``qpos0`` for an MJCF, shape
            (nq,).
        postures: Name of a keyframe → configuration, shape (nq,).
        couplings: Couplings of joints.
        warnings: Warnings, one line each.
        mjcf: The ``mujoco.MjModel``; ``None`` for a URDF.
    """

    model: pin.Model
    neutral: Array
    postures: Mapping[str, Array]
    couplings: tuple[JointCoupling, ...]
    warnings: tuple[str, ...]
    mjcf: Any = None


def read_description(path: Path, root: Root | None, *, accept_inertias: bool) -> RobotDescription:
    """Read a URDF, or an MJCF (see :func:`~impact_posture.robot.mjcf_file.is_mjcf`).

    ``root`` replaces the root of the file; ``None`` keeps it.  The root of a URDF is ``fixed``.

    Raises:
        UrdfError: The file cannot be read or does not describe a robot.
        InputError: The file is an MJCF, and MuJoCo is not installed.
    """
    if is_mjcf(path):
        file = read_mjcf(path, root)
        model = model_of(file.model, file.couplings)
        postures = {name: configuration(model, file.model, entries) for name, entries in file.keyframes.items()}
        neutral = configuration(model, file.model)
        return RobotDescription(model, neutral, postures, file.couplings, file.notes, file.model)
    model, warnings, couplings = build_model(path, free_flyer=root == "free-flyer", accept_inertias=accept_inertias)
    return RobotDescription(model, pin.neutral(model), {}, present(couplings, model), warnings)
