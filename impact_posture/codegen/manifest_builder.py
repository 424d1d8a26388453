"""Build the manifest of an export: robot, frames, metric, objective and self-test."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.codegen.c_literals import DOUBLE, Real
from impact_posture.codegen.export_functions import FUNCTIONS
from impact_posture.codegen.export_library import named_objectives
from impact_posture.codegen.manifest_reader import SCHEMA
from impact_posture.codegen.self_test import self_test
from impact_posture.impact.elasticity.contact_compression import Compression
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array
from impact_posture.version import __version__


def build_manifest(
    objectives: Sequence[WorstCaseObjective],
    prefix: str,
    posture: Array | None,
    compression: Compression | None,
    real: Real = DOUBLE,
    stack_bytes: int = 0,
    *,
    portable: bool = False,
    cuda: bool = False,
) -> dict[str, Any]:
    """Return the manifest of an export.

    The key ``frames`` has one entry for each frame; the top level repeats the keys of the first entry.  In each
    entry, the key ``free`` contains C names and self-test for the robot without its supports.  ``free`` is null if
    the robot has no supports.  The key ``several`` contains the contacts, C names and self-test of the objective of
    several simultaneous contacts.
    """
    first = objectives[0]
    robot, metric = first.robot, first.metric
    frames: list[dict[str, Any]] = []
    joint: dict[str, Any] | None = None
    for v in named_objectives(objectives, prefix):
        if v.joint:
            joint = _joint_block(v.objective, v.stem, real)
            continue
        block = _frame_block(v.objective, v.stem, real)
        if v.free:
            frames[-1]["free"] = {key: block[key] for key in ("symbols", "self_test")}
        else:
            frames.append(block | {"free": None})
    symbols = frames[0]["symbols"] | {"manifest": f"{prefix}_manifest"}
    if posture is not None:
        symbols |= {"posture": f"{prefix}_posture"}
    if joint is not None:
        symbols |= joint["symbols"]
    return {
        "schema": SCHEMA,
        "prefix": prefix,
        "real": real.name,
        "portable": portable,
        "cuda": cuda,
        "stack_bytes": stack_bytes,
        "model_sha256": robot.model_sha256,
        "robot": robot.name,
        "joint_names": list(robot.joint_names),
        "convention": robot.convention,
        "q_names": list(robot.q_names),
        "v_names": list(robot.tangent_names),
        "nq": robot.nq,
        "nv": robot.nv,
        "metric": {"name": metric.kind, "weights": None if metric.weights is None else list(metric.weights)},
        "objective": first.name,
        "objective_units": first.units,
        "objective_kink": first.impact_kind.kink,
        "normal_cone_deg": first.normal_cone_deg,
        "scenarios": [variant.to_dict() for variant in first.model_variants],
        "several": joint,
        "supports": [{"frame": s.frame, "kind": s.kind, "offset": list(s.offset)} for s in first.supports],
        "support_compliance": first.compliance if first.supports else None,
        "armature": robot.armature.tolist(),
        "joint_model": robot.joint_model,
        "compression": None if compression is None else compression.to_dict(),
        "posture": None if posture is None else posture.tolist(),
        **frames[0],
        "symbols": symbols,
        "frames": frames,
        "versions": {
            "impact_posture": __version__,
            "casadi": str(ca.CasadiMeta.version()),
            "pinocchio": str(pin.printVersion()),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def _joint_block(objective: WorstCaseObjective, stem: str, real: Real) -> dict[str, Any]:
    contacts = [contact.to_dict() for contact in objective.contacts]
    for contact in contacts:
        del contact["offset"]
    return {
        "contacts": contacts,
        "bilateral": objective.bilateral,
        "symbols": {name: f"{stem}_{name}" for name in ("objective", "objective_batch")},
        "self_test": self_test(objective, real),
    }


def _frame_block(objective: WorstCaseObjective, stem: str, real: Real) -> dict[str, Any]:
    return {
        **objective.contact.to_dict(),
        "symbols": {name: f"{stem}_{name}" for name in FUNCTIONS},
        "self_test": self_test(objective, real),
    }
