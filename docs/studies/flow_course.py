"""Run the reference flow of an exported controller in C, without the other parts of a tick."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from docs.studies.core import Vector
from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.export_controller import export_controller
from impact_posture.errors import MetricError
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.robot.robot import Robot
from impact_posture.system.libraries import library_path, load_library
from impact_posture.tsid.flow.flow_direction import FlowOptions
from impact_posture.tsid.flow.reference_flow import UPDATE_TICKS
from impact_posture.tsid.flow.reference_flow_posture import ReferenceFlowPosture
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.task_formulation import (
    TaskFormulation,
    aerial_formulation,
    arm_formulation,
    legged_formulation,
)
from impact_posture.tsid.tasks.joint_posture import JointPosture

DT = 1e-3
UPDATE = DT * UPDATE_TICKS
_DRIVER = Path(__file__).with_suffix(".c")
_BUILDERS = {"aerial": aerial_formulation, "arm": arm_formulation}


def formulation_for(robot: Robot, posture: JointPosture) -> TaskFormulation:
    """Return the task formulation that is used for this kind of robot."""
    return _BUILDERS.get(robot.spec.kind, legged_formulation)(robot, posture)


@dataclass(frozen=True)
class Course:
    """Course of a flow from its start until it rests.

    Attributes:
        q: Posture at the end, shape (nq,).
        values: ``H`` at each update, shape (k,).
        rested: Time at which the flow came to rest, s; infinite if it did not.
        missed: Largest error of the contacts and tasks, m or rad.
        share: Largest static actuator load during the flow, divided by the allowed load.
        room: Smallest distance of a joint from its limit, minus the required margin, rad or m.
        failures: Number of steps in which the solver failed.
    """

    q: Vector
    values: Vector
    rested: float
    missed: float
    share: float
    room: float
    failures: int


class CompiledFlow:
    """Reference flow of a problem, computed by an exported controller in C.

    Args:
        problem: Problem with the objective that the flow minimizes.
        folder: New folder for the code.
    """

    def __init__(self, problem: ConstrainedProblem, folder: Path) -> None:
        robot = self.robot = problem.robot

        def gradient(q: Vector) -> tuple[float, Vector]:
            return problem.objective.value(q), problem.objective.gradient(q)

        posture = ReferenceFlowPosture(robot, gradient, path=robot.posture())
        formulation = formulation_for(robot, posture)
        export_controller(robot, formulation, folder, objective=problem.objective, prefix="course")
        with (folder / "course.c").open("a", encoding="utf-8") as source:
            source.write(_DRIVER.read_text(encoding="utf-8"))
        self._controller = CompiledController.load(folder, robot=robot)
        library = load_library(library_path(folder, "course"))
        self._begin, self._run = library.course_begin, library.course_run
        self._ranges, moving = JointRanges(robot), np.ones(robot.nv, dtype=bool)
        moving[robot.held_entries] = False
        self._moving = np.flatnonzero(moving & np.isfinite(self._ranges.upper - self._ranges.lower))

    def share(self, q: Vector) -> float:
        """Return the static actuator load of a posture over the allowed load; infinite if the flow cannot begin."""
        rows = self._begun(q, FlowOptions(), None)
        return np.inf if rows is None else float(rows[1])

    def course(self, q: Vector, longest: float, options: FlowOptions, first: Vector | None = None) -> Course:
        """Run the flow from ``q`` for at most ``longest`` seconds; the flow visits the posture ``first`` first."""
        begun = self._begun(q, options, first)
        if begun is None:
            raise MetricError("the flow cannot begin at this posture", where="course", hint="start elsewhere")
        rows = np.zeros((round(longest / UPDATE), begun.size))
        done = self._run(self._controller._context, ctypes.c_double(DT), len(rows), _pointer(rows))
        rows = np.vstack([begun, rows[:done]])
        # Each update first evaluates its posture, then moves.
        rested = done * UPDATE if done < round(longest / UPDATE) else np.inf
        share, missed = rows[:, 1].max(), rows[:, 2].max()
        room, failures = self._room(rows[:, 4:], options), int(rows[-1, 3])
        return Course(rows[-1, 4:], rows[:, 0], rested, missed, share, room, failures)

    def _begun(self, q: Vector, options: FlowOptions, first: Vector | None) -> Vector | None:
        controller, row = self._controller, np.zeros(4 + self.robot.nq)
        for option in fields(options):
            controller.parameters[f"flow_{option.name}"][:] = getattr(options, option.name)
        if first is not None:
            controller.parameters["flow_path"][:] = first
        parameters, start = ctypes.byref(controller._given), _pointer(np.ascontiguousarray(q))
        refused = self._begin(controller._context, parameters, start, int(first is not None), _pointer(row))
        return None if refused else row

    def _room(self, q: Vector, options: FlowOptions) -> float:
        """Return the smallest distance of a moving joint from its limit, minus the margin of the joint."""
        at, ranges = q[:, self._ranges.index[self._moving]], self._ranges
        upper, lower = ranges.upper[self._moving], ranges.lower[self._moving]
        margin = np.minimum(options.joint_margin, (upper - lower) / 8)
        return float((np.minimum(at - lower, upper - at) - margin).min(initial=np.inf))


def _pointer(values: Vector) -> ctypes.Array[ctypes.c_double]:
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
