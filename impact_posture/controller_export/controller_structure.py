"""Structure of a controller that is fixed in its C code: sizes, tasks, contacts and the order of the rows."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot, unit_parts
from impact_posture.tsid.actuators import Actuators
from impact_posture.tsid.assembly import Assembly
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.point_kinematics import Point
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.tsid.tasks.body_tasks import BaseOrientation, CenterOfMass, Tilt
from impact_posture.tsid.tasks.frame_tasks import FrameAligned, FramePose, FramePosition, FrameTask
from impact_posture.tsid.tasks.impact_robust import ImpactRobustPosture
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture.tsid.tasks.task import Task

# Task classes; the position in this tuple is the number of the class in C.
_KINDS: tuple[type[Task], ...] = (Tilt, BaseOrientation, CenterOfMass, FramePosition, FramePose, FrameAligned)
_POSTURES = (JointPosture, ImpactRobustPosture, ReferenceFlowPosture)
# Number in C of each family of joints.
_FAMILIES = {"revolute": 0, "prismatic": 0, "continuous": 1, "free-flyer": 2, "spherical": 3}


@dataclass(frozen=True, eq=False)
class Structure:
    """Formulation with the sizes and tables that its C code needs.

    Attributes:
        formulation: Tasks, contacts and limits.
        actuators: Rotors and motors.
        tasks: Tasks of the strict levels, then the weighted tasks.
        points: Points whose kinematics each tick computes.
        sizes: Name → value of each size that is fixed in the code.
        tables: Name → constant array of integers or doubles.
        levels: Names of the strict levels.
        bounds: Name of each bound, in the order of the multipliers in a report.
    """

    robot: Robot
    formulation: TaskFormulation
    actuators: Actuators
    tasks: tuple[Task, ...]
    points: tuple[Point, ...]
    sizes: dict[str, int]
    tables: dict[str, NDArray[Any]]
    levels: tuple[str, ...]
    bounds: tuple[str, ...]

    @property
    def robust(self) -> ImpactRobustPosture | None:
        """The posture task if it is impact-robust; otherwise ``None``."""
        posture = self.formulation.posture
        return posture if isinstance(posture, ImpactRobustPosture) else None

    @property
    def flow(self) -> ReferenceFlowPosture | None:
        """The posture task if it has a reference flow; otherwise ``None``."""
        posture = self.formulation.posture
        return posture if isinstance(posture, ReferenceFlowPosture) else None

    @property
    def turning(self) -> frozenset[Point]:
        """Points whose rotation is needed by a task, a sole or the measured force."""
        tasks = [t.point for t in self.tasks if isinstance(t, FramePose | FrameAligned)]
        soles = [c.point for c in self.formulation.contacts if c.kind == "surface"]
        pushed = [] if self.formulation.force_point is None else [self.formulation.force_point]
        return frozenset([*tasks, *soles, *pushed])


def structure_of(robot: Robot, formulation: TaskFormulation) -> Structure:
    """Return the structure of a formulation.

    Raises:
        InputError: A task, a limit or a joint has no C code; the message names it.
    """
    _check(robot, formulation)
    actuators = Actuators(robot)
    strict = tuple(task for level in formulation.levels for task in level)
    tasks, contacts, points = (*strict, *formulation.weighted), formulation.contacts, formulation.points
    # Copy the tasks, because an assembly changes their targets, and a running controller may use the same tasks.
    copied = tuple(tuple(map(copy, level)) for level in formulation.levels)
    copies = replace(formulation, levels=copied, weighted=tuple(map(copy, formulation.weighted)))
    assembly = Assembly(robot, copies, actuators)
    nv, rotors, spare = robot.nv, actuators.rotors, actuators.spare.shape[1]
    law, posture = formulation.law, formulation.posture
    momentum = _is_diagonal_in_momentum(robot, formulation)
    dense = (bool(formulation.weighted) or not assembly.contacts.hard.all()) and not momentum
    forces, hard = assembly.contacts.size, int(assembly.contacts.hard.sum())
    joints = nv - actuators.base
    sizes = {
        "NQ": robot.nq,
        "NV": nv,
        "BASE": actuators.base,
        "JOINTS": len(Chart(robot.model).slots),
        "ROTORS": rotors,
        "CONTROLS": actuators.controls,
        "SPARE": spare,
        "BLIND": actuators.blind.shape[1],
        "CONTACTS": len(contacts),
        "FORCES": forces,
        "HARD": hard,
        "SOFT": forces - hard,
        "STRICT": sum(t.size for t in strict),
        "ROWS": sum(t.size for t in tasks),
        "CONES": assembly.contacts.cone.shape[0],
        "TASKS": len(tasks),
        "POINTS": len(points),
        "FORCE_POINT": -1 if formulation.force_point is None else points.index(formulation.force_point),
        "POSTURE": int(posture is not None),
        "ROBUST": int(isinstance(posture, ImpactRobustPosture)),
        "STIFF": int(posture is not None and posture.stiffness is not None),
        "LAW": int(law is not None),
        "DENSE": int(dense),
        "MOMENTUM": int(momentum),
        "SIMPLE": joints if law is not None and not dense else 0,
        "VARIABLES": nv + spare + forces,
    }
    always = sizes["BLIND"] + hard + sizes["STRICT"]
    bounds = joints if law is not None and dense else 0
    sizes |= {"BOUNDED": bounds, "EQUATIONS": always}
    sizes["GENERAL"] = always + actuators.controls + sizes["CONES"] + bounds
    tables = _tables(robot, tasks, formulation, assembly)
    sizes |= {"UNITS": len(tables["unit"]) // 2, "LEVELS": len(tables["level_rows"])}
    _add_flow(robot, formulation, sizes, tables)
    doubles: dict[str, Any] = {
        "inverse": actuators.inverse,
        "blind": actuators.blind if rotors else np.eye(actuators.base),
        "spare": actuators.spare,
        # The axis of an aligned frame, and two directions orthogonal to the axis.
        "task_axis": [[t._axis, *t._across] if isinstance(t, FrameAligned) else np.zeros((3, 3)) for t in tasks],
    }
    if sizes["FLOW"] and robot.floating:
        doubles["upright"] = robot.upright
    arrays: dict[str, NDArray[Any]] = {name: np.array(v, dtype=np.int64) for name, v in tables.items()}
    arrays |= {name: np.array(values, dtype=float).ravel() for name, values in doubles.items()}
    # The acceleration bounds of joints come first if they bound variables, and last if they are rows.
    bounded, rows = assembly.names[actuators.base : nv], assembly.names[assembly.qp.n :]
    names = (*(bounded if sizes["SIMPLE"] else ()), *rows, *(bounded if bounds else ()))
    levels = tuple(name for name, _ in assembly.levels)
    return Structure(robot, formulation, actuators, tasks, points, sizes, arrays, levels, names)


def _tables(
    robot: Robot, tasks: tuple[Task, ...], formulation: TaskFormulation, assembly: Assembly
) -> dict[str, list[int]]:
    """Return the constant arrays of integers: joints, unit parts of ``q``, tasks, contacts and strict levels."""
    slots, units = Chart(robot.model).slots, [part for _, part in unit_parts(robot.model)]
    contacts, points = formulation.contacts, formulation.points
    return {
        "joint_family": [_FAMILIES[s.kind.family] for s in slots],
        "joint_q": [s.q.start for s in slots],
        "joint_v": [s.v.start for s in slots],
        "limit_q": JointRanges(robot).index.tolist(),
        "unit": [x for part in units for x in (part.start, part.stop - part.start)],
        "task_kind": [_KINDS.index(type(t)) for t in tasks],
        "task_point": [points.index(t.point) if isinstance(t, FrameTask) else -1 for t in tasks],
        "task_row": np.cumsum([0, *(t.size for t in tasks)]).tolist(),
        "task_impedance": [int(isinstance(t, FrameTask) and t._soften is not None) for t in tasks],
        "contact_point": [points.index(c.point) for c in contacts],
        "contact_row": np.cumsum([0, *(c.size for c in contacts)]).tolist(),
        "force_contact": [k for k, c in enumerate(contacts) for _ in range(c.size)],
        "contact_cone": np.cumsum([0, *(c.cone(np.eye(3)).shape[0] for c in contacts)]).tolist(),
        "contact_hard": [int(c.weight is None) for c in contacts],
        "level_rows": [rows.stop - rows.start for _, rows in assembly.levels],
    }


def _add_flow(
    robot: Robot, formulation: TaskFormulation, sizes: dict[str, int], tables: dict[str, list[int]]
) -> None:
    """Add sizes and tables of a reference flow.

    ``HELD`` is the number of rows of the constraints on the flow: contacts, tasks and held joints.  ``flow_led``
    numbers the tasks that the flow moves, from 1; all other tasks have the number zero.
    """
    posture = formulation.posture
    flow = posture if isinstance(posture, ReferenceFlowPosture) else None
    strict = sum(len(level) for level in formulation.levels)
    tasks = [task for task in formulation.tasks if task is not posture]
    leads = [k >= strict and isinstance(task, CenterOfMass | BaseOrientation) for k, task in enumerate(tasks)]
    held = [task.size for task, leading in zip(tasks, leads, strict=True) if not leading]
    fixed = robot.held_entries
    edges = max(4, 4 * sizes["CONTACTS"]) if sizes["CONTACTS"] else 0
    # The tilt of a floating base needs one additional row.
    placed = edges + int(robot.floating)
    size = int(flow is not None)
    if flow is not None:
        tables["flow_led"] = [sum(leads[: k + 1]) if leading else 0 for k, leading in enumerate(leads)]
        tables["flow_fixed"] = fixed
    rows = sizes["FORCES"] + sum(held) + len(fixed)
    sizes |= {
        "FLOW": size,
        "HELD": size * rows,
        "LARGEST": max(sizes["NV"], rows),
        "EDGES": size * edges,
        "PLACED": size * placed,
        "FLOW_ROWS": size * (sizes["NV"] - sizes["BASE"] + placed + sizes["CONTROLS"]),
        "PATH": 0 if flow is None else len(flow._path),
    }


def _is_diagonal_in_momentum(robot: Robot, formulation: TaskFormulation) -> bool:
    """Return whether the cost contains only center of mass, base orientation and a posture task without the base."""
    tasks, posture = formulation.weighted, formulation.posture
    kinds = {type(task) for task in tasks}
    return (
        robot.floating
        and kinds == {CenterOfMass, BaseOrientation}
        and len(tasks) == 2
        and all((task.weight > 0).all() for task in tasks)
        and all(contact.weight is None for contact in formulation.contacts)
        and (posture is None or not posture.weight[:3].any())
    )


def _check(robot: Robot, formulation: TaskFormulation) -> None:
    def refuse(what: str) -> InputError:
        return InputError(what, where="controller export", hint="run it in Python, or use tasks of this package")

    for task in formulation.tasks:
        known = _POSTURES if task is formulation.posture else _KINDS
        if type(task) not in known:
            raise refuse(f"task '{task.name}' ({type(task).__name__}) has no C code")
    if isinstance(formulation.posture, ReferenceFlowPosture) and formulation.contacts and not robot.floating:
        # The hint "run it in Python" would be wrong here, because Python also rejects a flow with contacts and a
        # fixed base.
        what = f"'{formulation.posture.name}' with contacts needs a floating base"
        raise InputError(what, where="controller export", hint="leave out `contacts`")
    if formulation.row_limits:
        raise refuse(f"'{formulation.row_limits[0].name}' ({type(formulation.row_limits[0]).__name__}) has no C code")
    for slot in Chart(robot.model).slots:
        if slot.kind.family not in _FAMILIES:
            raise refuse(f"joint '{slot.name}' ({slot.kind.family}) has no C code")
