"""From a scenario's gains to the program of a controller: the same tasks for all, but for the posture task."""

from __future__ import annotations

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import SpecError
from impact_posture.impact.contact import point_on
from impact_posture.simulation.scenario import Control, RepeatedContacts, Setup
from impact_posture.tsid.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.contacts import SupportContact, support_contacts
from impact_posture.tsid.frame_tasks import EndEffector, FrameAligned, FramePose, FramePosition, Impedance
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.task import Task
from impact_posture.tsid.task_formulation import TaskFormulation


def end_effector_task(setup: Setup) -> EndEffector | None:
    """The end effector's task, where the scenario has gains for one.

    Raises:
        SpecError: Gains for an end effector where nothing is touched, or none where something is.
    """
    control, task = setup.scenario.control, setup.scenario.task
    gains = control.end_effector
    if not isinstance(task, RepeatedContacts):
        if gains is not None:
            where = setup.scenario.source
            raise SpecError(
                "has [control.end_effector], but a push", where=where, hint="remove [control.end_effector]"
            )
        return None
    if gains is None:
        raise SpecError(
            "has contacts, but nothing that leads the frame there",
            where=setup.scenario.source,
            hint="add [control.end_effector]",
        )
    soften = None if control.apparent_mass is None else Impedance(control.apparent_mass)
    point = Point(task.frame, setup.scenario.shape.offset)
    common = {"name": "end effector", "impedance": soften, "kp": gains.kp, "kd": gains.kd, "weight": gains.weight}
    if gains.pose == "aligned":
        placed = Numeric(setup.robot.model).at(setup.q).placement(point_on(setup.robot, task.frame))
        return FrameAligned(point, placed.rotation.T @ setup.scenario.normal, **common)  # type: ignore[arg-type]
    kind = FramePose if gains.pose == "full" else FramePosition
    return kind(point, **common)  # type: ignore[arg-type]


def build_formulation(setup: Setup, posture: JointPosture, end_effector: EndEffector | None) -> TaskFormulation:
    """The program of a scenario with a posture task of its own.

    A robot with ``[control.footing]`` stands: contacts and friction constrain, center of mass, base orientation, end
    effector and posture weigh.  Any other has strict levels: level base, end effector, posture in the cost.

    Raises:
        SpecError: Gains for a task that the robot cannot have.
    """
    control, scenario = setup.scenario.control, setup.scenario
    _check_gains(setup)
    felt = None if end_effector is None or scenario.sensors.force_frame is None else end_effector.point
    if control.footing is not None:
        weighted: list[Task] = [
            task(kp=gains.kp, kd=gains.kd, weight=gains.weight)
            for task, gains in ((CenterOfMass, control.center_of_mass), (BaseOrientation, control.base))
            if gains is not None
        ]
        if end_effector is not None:
            weighted.append(end_effector)
        contacts, cost = _contacts(setup, control), control.footing.force_weight
        return TaskFormulation((), tuple(weighted), posture, contacts, force_point=felt, force_weight=cost)
    tilt = () if control.tilt is None else ((Tilt(kp=control.tilt.kp, kd=control.tilt.kd),),)
    hand = () if end_effector is None else ((end_effector,),)
    return TaskFormulation((*tilt, *hand), (), posture, force_point=felt)


def base_weight(setup: Setup) -> float | None:
    """Weight of the base's entries in the posture task: none, where other tasks lead a floating base."""
    return 0.0 if setup.robot.floating else None


def nominal_posture(setup: Setup) -> JointPosture:
    """The posture task that holds the start posture."""
    gains = setup.scenario.control.posture
    return JointPosture(setup.robot, kp=gains.kp, kd=gains.kd, weight=gains.weight, base_weight=base_weight(setup))


def _check_gains(setup: Setup) -> None:
    """Refuse gains that no task would take."""
    control, source = setup.scenario.control, setup.scenario.source
    stands, flies = control.footing is not None, setup.robot.floating
    for key, given, fits, why in (
        ("footing", control.footing, flies, "a base that is fixed"),
        ("tilt", control.tilt, flies and not stands, "feet" if stands else "a base that is fixed"),
        ("center_of_mass", control.center_of_mass, stands, "no [control.footing]"),
        ("base", control.base, stands, "no [control.footing]"),
    ):
        if given is not None and not fits:
            raise SpecError(f"has [control.{key}], but {why}", where=source, hint=f"remove [control.{key}]")


def _contacts(setup: Setup, control: Control) -> tuple[SupportContact, ...]:
    footing = control.footing
    assert footing is not None  # noqa: S101 (narrows a type)
    contacts = support_contacts(setup.robot, friction=footing.friction)
    if not contacts:
        raise SpecError(
            "has [control.footing], but the robot has no supports",
            where=setup.scenario.source,
            hint="name [[supports]] in robot.toml",
        )
    return tuple(
        SupportContact(c.point, c.kind, c.half, c.normal, c.friction, footing.least, c.kp, c.kd, c.weight)
        for c in contacts
    )
