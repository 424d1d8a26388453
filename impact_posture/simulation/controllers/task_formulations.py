"""Build the tasks of a controller from the gains of a scenario.  Controllers differ only in the posture task."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import FrameNotFound, SpecError
from impact_posture.impact.impact_contact import point_on
from impact_posture.simulation.controller_gains import StanceGains
from impact_posture.simulation.setup import Setup
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.support_contact import SupportContact, support_contacts
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.tasks.frame_tasks import EndEffector, Impedance, pose_task
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import Task


def end_effector_task(setup: Setup) -> EndEffector | None:
    """Return the task of the end effector; ``None`` if the scenario has no contacts.

    Raises:
        SpecError: The scenario has a push or throw and gains for an end effector, or contacts and no such gains.
    """
    scenario, gains = setup.scenario, setup.scenario.control.end_effector
    if scenario.contacts is None and gains is not None:
        what = "has [control.end_effector], but a " + ("push" if scenario.push else "throw")
        raise SpecError(what, where=scenario.source, hint="remove [control.end_effector]")
    if scenario.contacts is None or (scenario.falls and gains is None):
        return None
    if gains is None:
        what = "has contacts, but no gains for the end effector"
        raise SpecError(what, where=scenario.source, hint="add [control.end_effector]")
    mass, frame = scenario.control.apparent_mass, scenario.shape.frame
    impedance = None if mass is None else Impedance(mass)
    placement = Numeric(setup.robot.model).at(setup.q).placement(point_on(setup.robot, frame))
    axis, point = placement.rotation.T @ scenario.normal, Point(frame, scenario.shape.offset)
    options: dict[str, Any] = {"kp": gains.kp, "kd": gains.kd, "weight": gains.weight}
    return pose_task(point, gains.pose, axis, impedance=impedance, name="end effector", **options)


def build_formulation(setup: Setup, posture: JointPosture, end_effector: EndEffector | None) -> TaskFormulation:
    """Build the task formulation of a scenario with a given posture task.

    For a scenario with ``[control.footing]``, contacts and friction are constraints.  Center of mass, base
    orientation, end effector and posture are weighted tasks.  For other scenarios, the level base and the end
    effector are strict levels, and the posture is in the cost.

    Raises:
        SpecError: The scenario has gains for a task that is not available for this robot.
    """
    control, scenario = setup.scenario.control, setup.scenario
    _check_gains(setup)
    felt = None if end_effector is None or scenario.sensors.force_frame is None else end_effector.point
    tasks = () if end_effector is None else (end_effector,)
    if control.footing is None:
        tilt = () if control.tilt is None else ((Tilt(kp=control.tilt.kp, kd=control.tilt.kd),),)
        return TaskFormulation((*tilt, *((task,) for task in tasks)), (), posture, force_point=felt)
    weighted: list[Task] = [
        task(kp=gains.kp, kd=gains.kd, weight=gains.weight)
        for task, gains in ((CenterOfMass, control.center_of_mass), (BaseOrientation, control.base))
        if gains is not None
    ]
    contacts, cost = _contacts(setup, control.footing), control.footing.force_weight
    return TaskFormulation((), (*weighted, *tasks), posture, contacts, force_point=felt, force_weight=cost)


def posture_options(setup: Setup) -> dict[str, Any]:
    """Return the options of the posture task, which are the same for all controllers.

    The weight of a floating base is zero, because other tasks control the base.
    """
    gains, base = setup.scenario.control.posture, 0.0 if setup.robot.floating else None
    kd = 2 * np.sqrt(gains.kp) if gains.kd is None else gains.kd
    return {"kp": gains.kp, "kd": kd, "weight": gains.weight, "base_weight": base}


def nominal_posture(setup: Setup) -> JointPosture:
    """Return the posture task that holds the start posture."""
    return JointPosture(setup.robot, **posture_options(setup))


def _check_gains(setup: Setup) -> None:
    control, source = setup.scenario.control, setup.scenario.source
    stands, flies = control.footing is not None, setup.robot.floating
    for key, gains, fits, reason in (
        ("footing", control.footing, flies, "a base that is fixed"),
        ("tilt", control.tilt, flies and not stands, "feet" if stands else "a base that is fixed"),
        ("center_of_mass", control.center_of_mass, stands, "no [control.footing]"),
        ("base", control.base, stands, "no [control.footing]"),
    ):
        if gains is not None and not fits:
            raise SpecError(f"has [control.{key}], but {reason}", where=source, hint=f"remove [control.{key}]")


def _contacts(setup: Setup, footing: StanceGains) -> tuple[SupportContact, ...]:
    contacts = support_contacts(setup.robot, friction=footing.friction)
    for name in footing.lifted:
        if name not in [c.point.frame for c in contacts]:
            raise FrameNotFound(name, [c.point.frame for c in contacts], where="control.footing.lifted")
    contacts = tuple(c for c in contacts if c.point.frame not in footing.lifted)
    if not contacts:
        what = "has [control.footing], but the robot has no supports"
        raise SpecError(what, where=setup.scenario.source, hint="add [[supports]] to robot.toml")
    return tuple(replace(contact, least=footing.least) for contact in contacts)
