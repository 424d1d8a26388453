"""Formulations with the default gains of this package for each kind of robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.task_formulation import (
    END_EFFECTOR_KP,
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from impact_posture.tsid.tasks.frame_tasks import EndEffector, pose_task
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.tasks.joint_posture import JointPosture

ControllerKind = Literal["aerial", "legged", "arm"]
_BUILD: dict[str, Callable[..., TaskFormulation]] = {"aerial": aerial_formulation, "arm": arm_formulation}


def default_formulation(
    robot: Robot, kind: ControllerKind, objective: WorstCaseObjective | None = None, *, flow: bool = False
) -> TaskFormulation:
    """Return the formulation for a kind of robot, with default gains.

    For ``aerial`` and ``arm``, the end effector task constrains the same directions as ``optimize`` by default.

    Args:
        robot: The robot.
        kind: ``aerial``, ``legged`` or ``arm``.
        objective: The objective whose gradient the posture task follows; ``None`` for a nominal posture task.
        flow: If true, the posture task has a reference flow; otherwise, the impact-robust term.

    Raises:
        InputError: The robot is not of this kind, or its data do not name an end effector.
    """
    # The posture weight of a standing robot is smaller than the weights of the center of mass (10) and of the base
    # (1).
    kp, weight, base = (20.0, 0.1, 0.0) if kind == "legged" else (10.0, 1.0, None)
    if objective is None:
        posture = JointPosture(robot, kp=kp, weight=weight, base_weight=base)
    else:
        value, slope = objective.value, objective.gradient
        law = ReferenceFlowPosture if flow else ImpactRobustPosture
        posture = law(robot, lambda q: (value(q), slope(q)), kp=kp, weight=weight, base_weight=base)
    try:
        if kind == "legged":
            return legged_formulation(robot, posture)
        return _BUILD[kind](robot, posture, end_effector=_end_effector(robot, objective))
    except InputError as error:
        raise InputError(error.what, where=error.where, hint=_hint(robot, kind, error)) from None


def _end_effector(robot: Robot, objective: WorstCaseObjective | None) -> EndEffector | None:
    """Return the task of the end effector, or ``None`` if no frame is known.

    The end effector is the frame of the impact.  Without an impact, or if the pose mode of this frame is ``free``,
    the end effector is the default contact frame.  The pose mode of the end effector determines the task
    (:func:`~impact_posture.tsid.tasks.frame_tasks.pose_task`).  ``aligned`` uses the normal at the default posture.
    """
    frame, offset = robot.spec.contact.frame, robot.spec.contact.offset
    aligned = None
    if objective is not None and robot.contact_pose(objective.contact.frame) != "free":
        contact = objective.contact
        frame, offset = contact.frame, contact.offset
        aligned = np.array(contact.normal)
        if contact.normal_frame == "world":
            placed = Numeric(robot.model).at(robot.posture()).placement(point_on(robot, frame))
            aligned = placed.rotation.T @ aligned
    if frame is None:
        return None
    return pose_task(Point(frame, offset), robot.contact_pose(frame), aligned, kp=END_EFFECTOR_KP)


def _hint(robot: Robot, kind: ControllerKind, error: InputError) -> str:
    """Return a hint that names the correct controller kind of the robot, or data that the robot lacks."""
    if robot.floating and not robot.spec.supports and robot.spec.propulsion is None:
        return "name [propulsion] or [[supports]] in robot.toml"
    fits = "legged" if robot.spec.supports else "aerial" if robot.spec.propulsion else "arm"
    if fits != kind:
        return f"try {fits}"
    if robot.spec.contact.frame is None:
        return "give `frame` and `normal`, or name contact.frame in robot.toml"
    return error.hint or ""
