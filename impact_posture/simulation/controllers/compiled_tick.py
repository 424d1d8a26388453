"""Controller in compiled C code, which is built once for each formulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from impact_posture.controller_export.compiled_controller import TARGET, CompiledController
from impact_posture.controller_export.controller_parameters import parameters
from impact_posture.controller_export.controller_structure import Structure
from impact_posture.controller_export.daqp_sources import VERSION
from impact_posture.controller_export.export_controller import export_controller
from impact_posture.dynamics.model_parameters import ModelParameters, without_parameters
from impact_posture.errors import CompilerError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.simulation.scenario_objective import locked, objective_key
from impact_posture.simulation.world.sensor_noise import Reading
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import cache_folder, is_cached, library_path, source_key
from impact_posture.system.progress import tell
from impact_posture.system.toolchain import require_compiler
from impact_posture.tsid.controller import Command, Controller
from impact_posture.tsid.tasks.task import TargetTask

_PREFIX = "controller"
# Compiler options for the generated code.  For a humanoid, compiling with -O1 takes 2 s and makes ticks 10 % faster.
# Higher levels of optimization take much more time.
_QUICK = ("-O1",)


class CompiledTick:
    """Exported C controller (``library``) with the targets of the tasks in Python."""

    def __init__(self, controller: Controller, structure: Structure, library: CompiledController) -> None:
        self.library, self._controller, self._structure = library, controller, structure
        self._tasks = [t for t in controller.formulation.tasks if isinstance(t, TargetTask)]
        self._sent: dict[str, tuple[object, bytes, bytes]] = {}
        self._numbers = ModelParameters(structure.robot.model).values

    def reset(self, q: Array, v: Array) -> Command:
        """Start in the same state as the Python controller after its reset, with the same gains and targets."""
        for field in parameters(self._structure, self._controller.period):
            self.library.parameters[field.name][:] = field.value
        self.library.parameters["numbers"][:] = self._numbers
        if self._structure.robust is not None:
            # Copy the scale that Python has computed, so that both controllers use exactly the same value.
            self.library.parameters["robust_scale"][:] = self._structure.robust.scale
        self._sent.clear()
        self._lead()
        return self.library.reset(q, v)

    def tick(self, reading: Reading) -> Command:
        """Send the changed targets to C, and return the command for a sensor reading."""
        self._lead()
        return self.library.tick(reading.t, reading.q, reading.v, reading.force)

    def plan(self, times: Sequence[float], lead: Callable[[float], None]) -> tuple[Array, Array]:
        """Call ``lead`` for ticks at n times, and record how it changes the targets.

        Return two arrays: an array of shape (n, targets), which is 1 where a target changes before a tick, and an
        array of shape (n, targets, 25) with the changed targets.
        """
        targets = self.library.targets
        before = {name: row.copy() for name, row in targets.items()}
        led, leads = np.zeros((len(times), len(targets))), np.zeros((len(times), len(targets), TARGET))
        places = {name: k for k, name in enumerate(targets)}
        for tick, t in enumerate(times):
            lead(t)
            for name in self._lead():
                led[tick, places[name]], leads[tick, places[name]] = 1, targets[name]
        for name, row in before.items():
            targets[name][:] = row
        return led, leads

    def catch_up(self) -> None:
        """Set the state of the Python controller to the measured state of the last tick."""
        self._controller.state.update(*self.library.measured)

    def _lead(self) -> list[str]:
        """Send the changed targets to C, and return the names of the tasks with these targets."""
        moved = []
        for task in self._tasks:
            # Python assigns a new object to ``target`` to change a target, so a different object means a change by
            # Python.
            rates = task.target_velocity, task.target_acceleration
            now = (task.target, rates[0].tobytes(), rates[1].tobytes())
            sent = self._sent.get(task.name)
            if sent is None or sent[0] is not now[0] or sent[1:] != now[1:]:
                self.library.set_target(task.name, task.required_target(), *rates)
                self._sent[task.name] = now
                moved.append(task.name)
        return moved


def compiled_tick(controller: Controller, structure: Structure, objective: WorstCaseObjective | None) -> CompiledTick:
    """Return the controller as compiled C code from the cache; build it first if the cache does not contain it.

    Raises:
        InputError: The sources of DAQP are missing.
        CompilerError: There is no compiler, or the compiler failed.
        OutputError: The cache folder cannot be written, or other users can write to it.
    """
    folder = cache_folder("controllers") / _key(structure, objective)
    with locked(folder.with_suffix(".lock")):
        if not is_cached(library_path(folder, _PREFIX)):
            require_compiler("controller")
            tell("compiling the controller")
            options: dict[str, Any] = {"objective": objective, "prefix": _PREFIX, "build": True, "force": True}
            options |= {"generated": _QUICK, "shared": True}
            if export_controller(controller.robot, controller.formulation, folder, **options).library is None:
                raise CompilerError(
                    "the compiler wrote no library", where=str(folder), hint="set CC to another compiler"
                )
    # Do not use names of the manifest, because it may come from another robot with the same code.
    return CompiledTick(controller, structure, CompiledController.load(folder))


def _key(structure: Structure, objective: WorstCaseObjective | None) -> str:
    """Return a hash of everything that the compiled code depends on.

    Gains, limits, targets, armature and mounting are parameters of the code and not part of the hash.
    """
    robot = without_parameters(structure.robot)
    if objective is not None:
        # The friction of the impact affects only objectives whose gradient jumps between sticking and sliding.
        friction = objective.contact.friction if objective.impact_kind.kink else 0.0
        objective = replace(objective, robot=robot, contact=replace(objective.contact, friction=friction))
    points = [(robot.model.frames[robot.frame_id(point.frame)], point) for point in structure.points]
    content = [
        VERSION,
        repr(_QUICK),
        robot.model_sha256,
        repr(structure.sizes),
        repr({name: table.tolist() for name, table in structure.tables.items()}),
        repr((structure.actuators.G.tolist(), robot.model.gravity.vector.tolist())),
        repr([(task.name, type(task).__name__) for task in structure.formulation.tasks]),
        *[repr((frame.parentJoint, frame.placement.homogeneous.tolist(), point)) for frame, point in points],
        "" if objective is None else objective_key(objective),
    ]
    return source_key(content, "dynamics", "impact", "codegen", "controller_export", "tsid")
