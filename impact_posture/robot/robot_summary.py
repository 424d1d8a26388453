"""Summaries of robots as JSON content, for the commands ``robots`` and ``inspect``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.config.json_block import jsonable
from impact_posture.errors import ImpactPostureError
from impact_posture.robot.actuation import allocation, hover, lateral_force_range, thrust_limits
from impact_posture.robot.model_joints import ENDLESS, is_link, joint_family
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import known_robots
from impact_posture.robot.robot_spec import PropulsionSpec, read_spec
from impact_posture.robot.urdf import EXAMPLE_PREFIX, robots_data


def catalogue() -> list[dict[str, Any]]:
    """Return a summary of each known robot; only its ``robot.toml`` is read."""
    entries = []
    for name in known_robots():
        spec = read_spec(robots_data() / name / "robot.toml")
        urdf = spec.model.urdf or ""
        shipped = not urdf.startswith(EXAMPLE_PREFIX)
        entries.append(
            {
                "name": name,
                "kind": spec.kind,
                "description": spec.description,
                "root": spec.model.root or "fixed",
                "frame": spec.contact.frame,
                "supports": [support.frame for support in spec.supports],
                "urdf": f"impact-posture:{name}/{urdf}" if shipped else urdf,
                "from": "impact-posture" if shipped else EXAMPLE_PREFIX.rstrip(":"),
                "sources": list(spec.sources),
            }
        )
    return entries


def summarize(robot: Robot) -> dict[str, Any]:
    """Return joints, frames, mass, limits, postures, contact, supports and actuation of a robot."""
    spec = robot.spec
    summary: dict[str, Any] = jsonable({
        "name": robot.name,
        "kind": spec.kind,
        "description": spec.description,
        "source": robot.source,
        "model_sha256": robot.model_sha256,
        "root": robot.root,
        "convention": robot.convention,
        "nq": robot.nq,
        "nv": robot.nv,
        "q_names": robot.q_names,
        "mass": robot.mass,
        "locked": robot.locked,
        "couplings": robot.couplings,
        "armature_source": robot.armature_source,
        "joints": [_joint(robot, name) for name in robot.joint_names],
        "frames": _frames(robot),
        "postures": [_posture(robot, name) for name in robot.postures],
        "default_posture": robot.default_posture,
        "contact": vars(spec.contact)
        | {"pose": None if spec.contact.frame is None else robot.contact_pose(spec.contact.frame)},
        "supports": spec.supports,
        "constraints": spec.constraints,
        "actuation": _actuation(robot, spec.propulsion) if spec.propulsion and robot.floating else None,
        "sources": spec.sources,
        "warnings": robot.warnings,
    })  # fmt: skip
    return summary


def _joint(robot: Robot, name: str) -> dict[str, Any]:
    model, index = robot.model, robot.joint_id(name)
    k, v = int(model.idx_qs[index]), int(model.idx_vs[index])
    nq, nv = int(model.nqs[index]), int(model.nvs[index])
    family = joint_family(model.joints[index])
    bounded = nq == nv == 1
    return {
        "name": name,
        "type": family,
        "unit": "m" if family == "prismatic" else "rad",
        "nq": nq,
        "nv": nv,
        "lower": _limit(model.lowerPositionLimit[k]) if bounded else None,
        "upper": _limit(model.upperPositionLimit[k]) if bounded else None,
        "velocity": _limit(model.upperVelocityLimit[v]) or None,
        "effort": _limit(model.upperEffortLimit[v]) or None,
        "armature": robot.armature[v],
    }


def _frames(robot: Robot) -> list[dict[str, Any]]:
    frames = [robot.model.frames[robot.frame_id(name)] for name in dict.fromkeys(robot.frame_names)]
    names = robot.model.names
    return [{"name": str(f.name), "joint": str(names[f.parentJoint]), "link": is_link(f)} for f in frames]


def _posture(robot: Robot, name: str) -> dict[str, Any]:
    q = robot.posture(name)
    fault: str | None = None
    try:
        robot.check_posture(q, where=name)
    except ImpactPostureError as error:
        fault = error.what
    return {"name": name, "default": name == robot.default_posture, "q": q, "fault": fault}


def _actuation(robot: Robot, propulsion: PropulsionSpec) -> dict[str, Any]:
    """Return the rank and the condition of the allocation, and lateral force and hover at each posture.

    The condition number is ``None`` if the rank is below 6.  The lateral force is ``None`` if the base is not level.
    """
    model = robot.model
    rotors = allocation(model, propulsion)
    low, high = thrust_limits(propulsion)
    postures = []
    for name in robot.postures:
        q = robot.posture(name)
        held = hover(model, propulsion, q)
        level = pin.Quaternion(np.array(q[3:7])).toRotationMatrix()[2, 2] > 1 - 1e-6
        postures.append(
            {
                "posture": name,
                "feasible": held.feasible,
                "thrusts": held.thrusts,
                "thrust_margin": held.thrust_margin,
                "torque_margin": held.torque_margin,
                "violations": held.violations,
                "lateral_force": lateral_force_range(model, propulsion, q) if level else None,
            }
        )
    return {
        "rotors": len(propulsion.rotors),
        "frame": propulsion.frame,
        "thrust_min": low,
        "thrust_max": high,
        "rank": rotors.rank,
        "condition": rotors.condition,
        "postures": postures,
        "source": propulsion.source,
    }


def _limit(value: float) -> float | None:
    return value if abs(value) < ENDLESS else None
