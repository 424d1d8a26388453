"""From a scenario's gains to the program of a controller: the same tasks for all, but for the posture task."""

from __future__ import annotations

from impact_posture.errors import SpecError
from impact_posture.simulation.scenario import Control, RepeatedContacts, Setup
from impact_posture.tsid.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.contacts import Contact, support_contacts
from impact_posture.tsid.frame_tasks import FramePose, Impedance
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.program import Program


def end_effector_task(setup: Setup) -> FramePose | None:
    """The end effector's task, where the scenario has gains for one.

    Raises:
        SpecError: Gains for an end effector where nothing is touched.
    """
    control, task = setup.scenario.control, setup.scenario.task
    if control.end_effector is None:
        return None
    if not isinstance(task, RepeatedContacts):
        raise SpecError("has gains of an end effector, but a push", where=setup.scenario.source, mend="remove them")
    gains = control.end_effector
    soften = None if control.apparent_mass is None else Impedance(control.apparent_mass)
    point = Point(task.frame, setup.scenario.shape.offset)
    return FramePose(point, name="end effector", impedance=soften, kp=gains.kp, kd=gains.kd)


def build_program(setup: Setup, posture: JointPosture, end_effector: FramePose | None) -> Program:
    """The program of a scenario with a posture task of its own.

    A robot with ``[control.footing]`` stands: contacts and friction constrain, center of mass, base orientation and
    posture weigh.  Any other has strict levels: level base, end effector, posture in the cost.

    Raises:
        SpecError: Gains for a task that the robot cannot have.
    """
    control, scenario = setup.scenario.control, setup.scenario
    if scenario.control.footing is not None:
        weighted = [
            task(kp=gains.kp, kd=gains.kd, weight=gains.weight)
            for task, gains in ((CenterOfMass, control.center_of_mass), (BaseOrientation, control.base))
            if gains is not None
        ]
        contacts = _contacts(setup, control)
        return Program((), tuple(weighted), posture, contacts, force_weight=scenario.control.footing.force_weight)
    if control.tilt is not None and not setup.robot.floating:
        raise SpecError("has gains of a tilt, but a fixed base", where=scenario.source, mend="remove [control.tilt]")
    tilt = () if control.tilt is None else ((Tilt(kp=control.tilt.kp, kd=control.tilt.kd),),)
    hand = () if end_effector is None else ((end_effector,),)
    felt = None if end_effector is None or scenario.scene.sensors.force_frame is None else end_effector.point
    return Program((*tilt, *hand), (), posture, force_point=felt)


def base_weight(setup: Setup) -> float | None:
    """Weight of the base's entries in the posture task: none, where other tasks lead a floating base."""
    return 0.0 if setup.robot.floating else None


def nominal_posture(setup: Setup) -> JointPosture:
    """The posture task that holds the start posture."""
    gains = setup.scenario.control.posture
    return JointPosture(setup.robot, kp=gains.kp, kd=gains.kd, weight=gains.weight, base_weight=base_weight(setup))


def _contacts(setup: Setup, control: Control) -> tuple[Contact, ...]:
    footing = control.footing
    assert footing is not None
    contacts = support_contacts(setup.robot, friction=footing.friction)
    if not contacts:
        raise SpecError(
            "has [control.footing], but the robot has no supports",
            where=setup.scenario.source,
            mend="name [[supports]] in robot.toml",
        )
    return tuple(
        Contact(c.point, c.kind, c.half, c.normal, c.friction, footing.least, c.kp, c.kd, c.weight) for c in contacts
    )
