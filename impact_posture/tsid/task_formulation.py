"""What a controller is asked to do: tasks in strict levels, tasks by weight, a posture, contacts and limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.tsid.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.contacts import SupportContact, support_contacts
from impact_posture.tsid.frame_tasks import EndEffector, FramePose
from impact_posture.tsid.limits import LimitLaw
from impact_posture.tsid.points import Point
from impact_posture.tsid.posture_tasks import JointPosture
from impact_posture.tsid.task import Task


@dataclass(frozen=True, eq=False)
class TaskFormulation:
    """One kind of TSID.

    Attributes:
        levels: Tasks that hold as equalities, the most important level first (Afifi et al. 2026, Problems 2 and 3).
        weighted: Tasks in the cost, ``Σ wᵢ‖ÿᵢ − ÿᵢ*‖²`` (Problem 1).
        posture: The posture task, in the cost: ``‖ν̇ − ν̇*‖²_W``.
        contacts: What stands on the ground.
        force_point: Where a measured contact force acts; ``None``: it is left out of the dynamics.
        law: How joints are stopped at their limits; ``None``: nothing limits the accelerations.
        force_weight: Of contact forces in the cost, 1/N² (a hundred times that for moments, 1/(N·m)²).
        spare_weight: Of what more rotors than needed leave to choose, 1/N².
    """

    levels: tuple[tuple[Task, ...], ...] = ()
    weighted: tuple[Task, ...] = ()
    posture: JointPosture | None = None
    contacts: tuple[SupportContact, ...] = ()
    force_point: Point | None = None
    law: LimitLaw | None = field(default_factory=LimitLaw)
    force_weight: float = 1e-6
    spare_weight: float = 1e-3

    def __post_init__(self) -> None:
        """Refuse a program without anything to do, and names that stand for two tasks."""
        names = [task.name for task in self.tasks]
        if not names:
            raise InputError("has no task", where="program", hint="give tasks or a posture")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"two tasks are called '{twice[0]}'", where="program", hint="name them apart")
        if not (self.force_weight > 0 and self.spare_weight > 0):
            raise InputError("a weight is not positive", where="program", hint="give positive weights")

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks, levels first, posture last."""
        strict = tuple(task for level in self.levels for task in level)
        return (*strict, *self.weighted, *(() if self.posture is None else (self.posture,)))

    @property
    def points(self) -> tuple[Point, ...]:
        """All points that the state must follow, contacts first."""
        found = [c.point for c in self.contacts] + [p for task in self.tasks for p in task.points]
        if self.force_point is not None:
            found.append(self.force_point)
        return tuple(dict.fromkeys(found))


def aerial_formulation(
    robot: Robot,
    posture: JointPosture,
    *,
    end_effector: EndEffector | None = None,
    tilt: Tilt | None = None,
    order: Literal["strict", "weighted"] = "strict",
    law: LimitLaw | None = LimitLaw(),
) -> TaskFormulation:
    """The paper's stack for an aerial manipulator: tilt, then end effector, then posture.

    Args:
        robot: The robot; the end effector is its default contact frame.
        posture: Nominal (:class:`JointPosture`), or impact-robust.
        end_effector: Instead of a pose with ``kp = 60``; the measured force acts at its point.
        tilt: Instead of one with ``kp = 100``.
        order: ``strict``: tilt and end effector as equalities (Problems 2 and 3).  ``weighted``: all in the cost,
            with the tasks' own weights (Problem 1).
        law: Of the joint limits.

    Raises:
        InputError: The robot does not fly, or has no default contact frame.
    """
    if not robot.floating:
        raise InputError("the base is fixed", where=robot.name, hint="use arm_formulation")
    if robot.spec.propulsion is None:
        raise InputError("has no propellers", where=robot.name, hint="name [propulsion] in robot.toml")
    end_effector = end_effector or _end_effector(robot)
    tilt = tilt or Tilt()
    point = end_effector.point
    if order == "strict":
        return TaskFormulation(((tilt,), (end_effector,)), (), posture, force_point=point, law=law)
    return TaskFormulation((), (tilt, end_effector), posture, force_point=point, law=law)


def arm_formulation(
    robot: Robot,
    posture: JointPosture,
    *,
    end_effector: EndEffector | None = None,
    order: Literal["strict", "weighted"] = "strict",
    law: LimitLaw | None = LimitLaw(),
) -> TaskFormulation:
    """The same stack for an arm on a fixed base, which has no tilt: end effector, then posture.

    Args:
        robot: The robot; the end effector is its default contact frame.
        posture: Nominal or impact-robust.
        end_effector: Instead of a pose with ``kp = 60``; the measured force acts at its point.
        order: ``strict``: the end effector as an equality.  ``weighted``: in the cost, with its own weight.
        law: Of the joint limits.

    Raises:
        InputError: The base floats, or the robot has no default contact frame.
    """
    if robot.floating:
        raise InputError("the base floats", where=robot.name, hint="use aerial_formulation or legged_formulation")
    task = end_effector or _end_effector(robot)
    levels, weighted = (((task,),), ()) if order == "strict" else ((), (task,))
    return TaskFormulation(levels, weighted, posture, force_point=task.point, law=law)


def legged_formulation(
    robot: Robot,
    posture: JointPosture,
    *,
    kp: float = 20.0,
    friction: float = 0.7,
    center_of_mass: CenterOfMass | None = None,
    base: BaseOrientation | None = None,
    contacts: tuple[SupportContact, ...] | None = None,
    force_point: Point | None = None,
    law: LimitLaw | None = LimitLaw(),
) -> TaskFormulation:
    """The paper's stack for a standing robot: contacts and friction, center of mass, base orientation, posture.

    Args:
        robot: The robot; it stands on the supports of its ``robot.toml``.
        posture: Nominal or impact-robust; its weight says how it compares with the others (10 and 1).
        kp: Stiffness of center of mass and base orientation, 1/s².
        friction: Coulomb coefficient of the ground.
        center_of_mass: Instead of one with weight 10.
        base: Instead of one with weight 1.
        contacts: Instead of the robot's supports.
        force_point: Where a measured contact force acts that is none of the feet's; ``None``: it is left out.
        law: Of the joint limits.

    Raises:
        InputError: The robot has no supports.
    """
    contacts = support_contacts(robot, friction=friction) if contacts is None else contacts
    if not contacts:
        raise InputError(
            "has no supports", where=robot.name, hint="name [[supports]] in robot.toml, or give contacts"
        )
    weighted = (
        center_of_mass or CenterOfMass(kp=kp, weight=10.0),
        base or BaseOrientation(kp=kp, weight=1.0),
    )
    return TaskFormulation((), weighted, posture, contacts, force_point, law)


def _end_effector(robot: Robot) -> FramePose:
    frame = robot.spec.contact.frame
    if frame is None:
        raise InputError("has no default contact frame", where=robot.name, hint="give the end effector's task")
    return FramePose(Point(frame), kp=60.0)
