"""Formulation of a controller: strict levels of tasks, weighted tasks, a posture task, contacts and limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from impact_posture.config.checked import checked
from impact_posture.config.demand import Positive
from impact_posture.config.problem_settings import FRICTION
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.limits.acceleration_bounds import LimitLaw
from impact_posture.tsid.limits.impact_limits import ImpactLimits
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.state import State
from impact_posture.tsid.support_contact import SupportContact, support_contacts
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.tasks.frame_tasks import EndEffector, FramePose
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import TargetTask, Task

Order = Literal["strict", "weighted"]
# Default stiffness of the end effector's task, 1/s².
END_EFFECTOR_KP = 60.0


@checked
@dataclass(frozen=True, eq=False)
class TaskFormulation:
    """Tasks, contacts and limits of the QP of each tick.

    Attributes:
        levels: Levels of tasks as equality constraints, the most important level first (Afifi et al. 2026, Problems 2
            and 3).
        weighted: Tasks in the cost, ``Σ wᵢ‖ÿᵢ − ÿᵢ*‖²`` (Problem 1).
        posture: Posture task in the cost, ``‖ν̇ − ν̇*‖²_W``; ``None`` for no posture task.
        contacts: Contacts with the ground.
        force_point: Point where a measured contact force acts; with ``None``, the dynamics ignore measured forces.
        law: Law that stops joints at their limits; with ``None``, the accelerations are unlimited.
        row_limits: Limits for expected impacts; like joint limits, these limits are relaxed if they are infeasible.
        force_weight: Weight of contact forces in the cost, 1/N².  The weight of moments is a hundred times as large,
            1/(N·m)².
        spare_weight: Weight of the thrusts in the null space of redundant rotors, 1/N².
    """

    levels: tuple[tuple[Task, ...], ...] = ()
    weighted: tuple[Task, ...] = ()
    posture: JointPosture | None = None
    contacts: tuple[SupportContact, ...] = ()
    force_point: Point | None = None
    law: LimitLaw | None = field(default_factory=LimitLaw)
    row_limits: tuple[ImpactLimits, ...] = ()
    force_weight: Positive = 1e-6
    spare_weight: Positive = 1e-3

    def __post_init__(self) -> None:
        """Raise :class:`InputError` if there are no tasks or two tasks have the same name."""
        names = [task.name for task in self.tasks]
        if not names:
            raise InputError("has no task", where="program", hint="give tasks or a posture")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"two tasks are called '{twice[0]}'", where="program", hint="rename one of them")

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks: first the strict levels, then the weighted tasks, last the posture task."""
        strict = tuple(task for level in self.levels for task in level)
        return (*strict, *self.weighted, *(() if self.posture is None else (self.posture,)))

    @property
    def points(self) -> tuple[Point, ...]:
        """All points whose kinematics the state object computes, contacts first."""
        points = [c.point for c in self.contacts] + [p for task in self.tasks for p in task.points]
        points += [p for limit in self.row_limits for p in limit.points]
        return tuple(dict.fromkeys(points if self.force_point is None else [*points, self.force_point]))

    def lead(self, state: State, a: Array) -> None:
        """Move the targets of all tasks along a motion with ``q`` and ``ν`` of ``state`` and ``ν̇ = a``, shape (nv,).

        A target becomes the output of its task, with its velocity ``Jν`` and its acceleration ``Jν̇ + J̇ν``.
        """
        for task in self.tasks:
            if isinstance(task, TargetTask):
                J = task.jacobian(state)
                task.target = task.present(state)
                task.target_velocity, task.target_acceleration = J @ state.v, J @ a + task.drift(state)
        if self.posture is not None:
            self.posture.lead(state.q, state.v, a)


@checked
def aerial_formulation(
    robot: Robot,
    posture: JointPosture,
    *,
    end_effector: EndEffector | None = None,
    tilt: Tilt | None = None,
    order: Order = "strict",
    law: LimitLaw | None = LimitLaw(),
) -> TaskFormulation:
    """Return the tasks of Afifi et al. 2026 for an aerial manipulator: tilt, then end effector, then posture.

    Args:
        robot: The robot, whose default contact frame is the end effector.
        posture: Nominal posture task (:class:`JointPosture`), or an impact-robust posture task.
        end_effector: Task of the end effector; by default, a pose task with ``kp = 60``.  A measured force acts at
            the point of this task.
        tilt: Task of the tilt; by default, a tilt task with ``kp = 100``.
        order: With ``strict``, tilt and end effector are equality constraints (Problems 2 and 3).  With ``weighted``,
            all tasks are in the cost, with their weights (Problem 1).
        law: Law that stops joints at their limits (:class:`LimitLaw`).

    Raises:
        InputError: The robot does not fly, or has no default contact frame.
    """
    if not robot.floating:
        raise InputError("the base is fixed", where=robot.name, hint="use arm_formulation")
    if robot.spec.propulsion is None:
        raise InputError("has no propellers", where=robot.name, hint="name [propulsion] in robot.toml")
    return _manipulator(robot, (tilt or Tilt(),), end_effector, posture, order, law)


@checked
def arm_formulation(
    robot: Robot,
    posture: JointPosture,
    *,
    end_effector: EndEffector | None = None,
    order: Order = "strict",
    law: LimitLaw | None = LimitLaw(),
) -> TaskFormulation:
    """Return the tasks of :func:`aerial_formulation` without the tilt task, for an arm on a fixed base.

    The arguments have the same meaning as in :func:`aerial_formulation`.

    Raises:
        InputError: The base floats, or the robot has no default contact frame.
    """
    if robot.floating:
        raise InputError("the base floats", where=robot.name, hint="use aerial_formulation or legged_formulation")
    return _manipulator(robot, (), end_effector, posture, order, law)


@checked
def legged_formulation(
    robot: Robot,
    posture: JointPosture,
    *,
    kp: Positive = 20.0,
    friction: Positive = FRICTION,
    center_of_mass: CenterOfMass | None = None,
    base: BaseOrientation | None = None,
    contacts: tuple[SupportContact, ...] | None = None,
    force_point: Point | None = None,
    law: LimitLaw | None = LimitLaw(),
) -> TaskFormulation:
    """Return the tasks of Afifi et al. 2026 for a standing robot: center of mass, base orientation and posture.

    Args:
        robot: The robot, which stands on the supports of its ``robot.toml``.
        posture: Nominal or impact-robust posture task.
        kp: Stiffness of center of mass and base orientation, 1/s².
        friction: Coulomb coefficient of the ground.
        center_of_mass: Task of the center of mass; by default, a task with weight 10.
        base: Task of the base orientation; by default, a task with weight 1.
        contacts: Contacts with the ground; by default, the robot's supports.
        force_point: Point, not at a foot, where a measured contact force acts.  With ``None``, the dynamics ignore
            measured forces.
        law: Law that stops joints at their limits (:class:`LimitLaw`).

    Raises:
        InputError: The robot has no supports.
    """
    contacts = support_contacts(robot, friction=friction) if contacts is None else contacts
    if not contacts:
        hint = "name [[supports]] in robot.toml, or give contacts"
        raise InputError("has no supports", where=robot.name, hint=hint)
    weighted = (center_of_mass or CenterOfMass(kp=kp, weight=10.0), base or BaseOrientation(kp=kp, weight=1.0))
    return TaskFormulation((), weighted, posture, contacts, force_point, law)


def _manipulator(
    robot: Robot,
    above: tuple[Task, ...],
    end_effector: EndEffector | None,
    posture: JointPosture,
    order: Order,
    law: LimitLaw | None,
) -> TaskFormulation:
    """Return the tasks in ``above``, the end effector and the posture; each strict task is one level."""
    frame = robot.spec.contact.frame
    if end_effector is None:
        if frame is None:
            raise InputError("has no default contact frame", where=robot.name, hint="give the end effector's task")
        end_effector = FramePose(Point(frame), kp=END_EFFECTOR_KP)
    tasks = (*above, end_effector)
    levels, weighted = (tuple((task,) for task in tasks), ()) if order == "strict" else ((), tasks)
    return TaskFormulation(levels, weighted, posture, force_point=end_effector.point, law=law)
