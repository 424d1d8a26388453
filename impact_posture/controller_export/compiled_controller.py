"""Run an exported C controller from Python, with the interface of ``tsid.Controller``.

This module does not import CasADi.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impact_posture.codegen.manifest_reader import check_library, check_robot
from impact_posture.config.checked import checked
from impact_posture.controller_export.compiled_report import STATUSES, read_report
from impact_posture.controller_export.controller_manifest import Manifest, build_controller, read_controller
from impact_posture.errors import ContactError, InputError, MetricError, PostureError, SpecError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import library_path, load_library
from impact_posture.tsid.controller import Command, Report

_FUNCTIONS = ("init", "reset", "tick", "last_report", "move_to", "lead_posture", "brace", "contact", "release")
# C functions of controllers with a reference flow.  Controllers of earlier versions lack these functions.
_OPTIONAL = ("brace_before", "lead")
# Number of doubles in a target: 1 (whether the target is set), 3 (position), 9 (rotation), 6 (velocity), and 6
# (acceleration).
TARGET = 25


class CompiledController:
    """Controller in a shared library, which computes a command from each measured state.

    Attributes:
        manifest: The content of ``<prefix>.json``.
        parameters: Parameter name → values, shape (size,).  Changes take effect at the next :meth:`reset`.
        targets: Task name → target of the task as stored in the memory of the C code, shape (25,).
    """

    def __init__(self, library: ctypes.CDLL, document: Mapping[str, Any], manifest: Manifest) -> None:
        """Connect to a loaded library.  Users call :meth:`load` instead."""
        self.manifest, self._checked = document, manifest
        sizes, bounds, prefix = manifest.sizes, len(manifest.bounds), manifest.prefix

        def room(name: str) -> int:
            return max(1, sizes[name])

        arrays = [("u", "CONTROLS"), ("rotor_speed", "ROTORS"), ("acceleration", "NV"), ("forces", "FORCES")]
        self._command, self._out = _structure([(n, room(s)) for n, s in arrays], ["status", "iterations"])
        rows = [("rows", room("ROWS")), ("contacts", room("FORCES")), ("posture", room("NV"))]
        rows += [("multipliers", max(1, bounds)), ("relaxed", 1 + len(manifest.levels))]
        rows += [("deficient", room("LEVELS")), ("dynamics", 1), ("level", 1), ("value", 1), ("target", manifest.nq)]
        self._report, self._diagnosis = _structure(rows, ["status", "iterations", "resting", "flow_failures"])
        self._given, self.parameters = _structure([*manifest.parameters.items()], [])
        bytes_ = ctypes.c_ulong.in_dll(library, f"{prefix}_context_bytes").value
        self._context = ctypes.create_string_buffer(bytes_)
        tasks = len(manifest.tasks)
        memory = memoryview(self._context)
        targets = np.frombuffer(memory, dtype=float, count=TARGET * tasks).reshape(tasks, TARGET)
        # In the context of the C code, the activation level is stored behind the targets.  C arrays cannot be empty,
        # so there is at least one target.
        self._level = np.frombuffer(memory, dtype=float, count=1, offset=8 * TARGET * max(1, tasks))
        self.targets = {task.name: row for task, row in zip(manifest.tasks, targets, strict=True)}
        self._q, self._v, self._force = np.zeros(manifest.nq), np.zeros(manifest.nv), np.zeros(6)
        self._pointers = [_pointer(x) for x in (self._q, self._v, self._force)]
        names = (*_FUNCTIONS, *(name for name in _OPTIONAL if hasattr(library, f"{prefix}_{name}")))
        self._functions = {name: getattr(library, f"{prefix}_{name}") for name in names}
        getattr(library, f"{prefix}_default_params")(ctypes.byref(self._given))
        self._ready = False

    @classmethod
    @checked
    def load(cls, path: str | Path, *, robot: Robot | None = None) -> CompiledController:
        """Load an exported controller.  **This runs the exported code**, so load only exports that you trust.

        If ``lib<prefix>.so`` is missing, the method builds it.  The library must contain the identity of the manifest
        in the folder.

        Args:
            path: The folder of the export, or its ``<prefix>.json``.
            robot: The robot that the manifest must match; with ``None``, the robot is not checked.

        Raises:
            SpecError: The export is missing or broken.
            ManifestMismatch: The export belongs to another robot, or the library belongs to another manifest.
            CompilerError: The library is missing and cannot be built.
        """
        document, manifest, folder = read_controller(Path(path))
        if robot is not None:
            check_robot(document, robot, where=str(path))
        target = library_path(folder, manifest.prefix)
        if not target.is_file():
            build_controller(folder, document)
        library = load_library(target)
        check_library(library, document, where=str(target))
        try:
            return cls(library, document, manifest)
        except (AttributeError, ValueError) as error:
            raise SpecError(f"lacks a function ({error})", where=str(target), hint="run codegen again") from None

    def reset(self, q: ArrayLike, v: ArrayLike) -> Command:
        """Start again at ``(q, ν)`` with the present parameters.  Targets that are already set stay the same.

        Raises:
            InputError: A parameter is out of range; the message names it.
            PostureError: ``q`` is not a configuration of the robot, or ``v`` is not a velocity.
            ValueError: The shape of an array is wrong.
            MetricError: At ``q``, the gradient of the posture task does not exist or is zero.
            ContactError: A sole stands on its edge.
        """
        self._measure(q, v)
        targets = {name: row.copy() for name, row in self.targets.items()}
        self._ready = False
        refused = self._call("init", ctypes.byref(self._given))
        if refused < 0:
            raise SpecError("has too little memory for the relaxation", where="controller", hint="run codegen again")
        if refused:
            name = list(self.parameters)[refused - 1]
            values = ", ".join(f"{x:g}" for x in self.parameters[name][:8])
            raise InputError(f"is out of range ({values})", where=f"parameter {name}", hint="see the header")
        for name, row in targets.items():
            self.targets[name][:] = row
        code = self._call("reset", *self._pointers[:2], ctypes.byref(self._command))
        if code == 1:
            what = "(q, v) is not a state of the robot"
            raise PostureError(what, where="reset", hint="give finite numbers and unit quaternions")
        if code == 3:
            raise ContactError("the sole stands on its edge", where="contact", hint="put the sole on the ground")
        if code:
            what = "the objective and its curvature are zero or do not exist"
            raise MetricError(what, where="reset", hint="start at another posture")
        self._ready = True
        return self._commanded()

    def tick(self, t: float, q: ArrayLike, v: ArrayLike, force: ArrayLike | None = None) -> Command:
        """Return the command at ``(q, ν)``.  The arguments are the same as in ``tsid.Controller.tick``.

        Raises:
            InputError: ``reset`` has not been called.
            ValueError: The shape of an array is wrong.
        """
        if not self._ready:
            raise InputError("has not been reset", where="controller", hint="call reset(q, v) first")
        self._measure(q, v)
        q_at, v_at, force_at = self._pointers
        if force is not None:
            measured = np.asarray(force, dtype=float)
            if measured.shape not in ((3,), (6,)):
                raise ValueError(f"a measured force has 3 or 6 numbers, not shape {measured.shape}")
            self._force[:] = 0.0
            self._force[: measured.size] = measured
        pushed = None if force is None else force_at
        self._call("tick", ctypes.c_double(t), q_at, v_at, pushed, ctypes.byref(self._command))
        return self._commanded()

    def _measure(self, q: ArrayLike, v: ArrayLike) -> None:
        q, v = _shaped(q, self._q.shape, "q"), _shaped(v, self._v.shape, "v")
        self._q[:], self._v[:] = q, v

    @property
    def measured(self) -> tuple[Array, Array]:
        """The measured state ``(q, ν)`` of the last tick."""
        return self._q.copy(), self._v.copy()

    def addresses(self) -> dict[str, int]:
        """Return memory addresses by name, and the number of ``targets``, for a loop of ticks in C."""
        arrays = {"q": self._q, "v": self._v, "force": self._force, "level": self._level}
        arrays |= {"u": self._out["u"], "rotor_speed": self._out["rotor_speed"]}
        addresses = {name: int(array.ctypes.data) for name, array in arrays.items()}
        addresses["tick"] = ctypes.cast(self._functions["tick"], ctypes.c_void_p).value or 0
        addresses["context"] = addresses["target"] = ctypes.addressof(self._context)
        addresses["command"] = ctypes.addressof(self._command)
        addresses["status"] = addresses["command"] + type(self._command).status.offset
        return addresses | {"targets": len(self.targets)}

    def report(self) -> Report:
        """Return the diagnosis of the last tick."""
        self._call("last_report", ctypes.byref(self._report))
        status, iterations = STATUSES[self._report.status], int(self._report.iterations)
        return read_report(self._checked, status, iterations, self._diagnosis)

    def set_target(
        self, task: str, target: pin.SE3 | ArrayLike, velocity: ArrayLike = 0.0, acceleration: ArrayLike = 0.0
    ) -> None:
        """Set the target of the task named ``task``.  The form of the target is the same as in ``tsid``.

        Raises:
            InputError: The controller has no such task.
            ValueError: The target of a pose is not a ``pin.SE3``, the target of an orientation does not have the
                shape (3, 3), or another target does not have the shape (3,).
        """
        row = self._target(task)
        rows = next(t.rows for t in self._checked.tasks if t.name == task)
        if isinstance(target, pin.SE3):
            row[1:4], row[4:13] = target.translation, target.rotation.ravel()
        else:
            numbers = np.asarray(target, dtype=float)
            if rows > 3 or numbers.shape not in ((3,), (3, 3)):
                wanted = "a pin.SE3" if rows > 3 else "an array of shape (3,) or (3, 3)"
                raise ValueError(f"the target of '{task}' must be {wanted}")
            row[slice(1, 4) if numbers.size == 3 else slice(4, 13)] = numbers.ravel()
        row[0], row[13 : 13 + rows], row[19 : 19 + rows] = 1.0, velocity, acceleration

    def forget_target(self, task: str) -> None:
        """Clear the target of a task, so that the next :meth:`reset` sets it to the present output.

        Raises:
            InputError: The controller has no such task.
        """
        self._target(task)[:] = 0.0

    def _target(self, task: str) -> Array:
        if task not in self.targets:
            known = ", ".join(self.targets) or "none"
            raise InputError(f"there is no task '{task}'", where="controller", hint=f"one of: {known}")
        return self.targets[task]

    def move_to(self, q: ArrayLike, over: float = 0.5) -> None:
        """Fade the target of the posture task to ``q``, shape (nq,), within ``over`` seconds.

        Raises:
            InputError: The posture or the time is invalid, or ``reset`` has not been called.
            ValueError: The shape of the posture is wrong.
        """
        q = _shaped(q, self._q.shape, "q")
        if self._call("move_to", _pointer(q), ctypes.c_double(over)):
            what = "the posture or the time is invalid"
            raise InputError(what, where="move_to", hint="give finite numbers and seconds above zero")

    def lead_posture(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> None:
        """Set ``q_des`` of the posture task, shape (nq,), with its velocity and acceleration, shape (nv,) each.

        Raises:
            InputError: A number is invalid, or ``reset`` has not been called.
            ValueError: The shape of an array is wrong.
        """
        self._lead("lead_posture", q, v, a)

    def lead(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> None:
        """Do the same as :meth:`lead_posture`, and set all other targets to their outputs in the same motion.

        The errors are the same as in :meth:`lead_posture`.
        """
        self._lead("lead", q, v, a)

    def _lead(self, function: str, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> None:
        n, nv = self._q.shape, self._v.shape
        arrays = [_shaped(q, n, "q"), _shaped(v, nv, "v"), _shaped(a, nv, "a")]
        if function not in self._functions:
            raise InputError("the controller has no such function", where=function, hint="run codegen again")
        if self._call(function, *map(_pointer, arrays)):
            raise InputError("a number is invalid", where=function, hint="give a posture and finite numbers")

    @property
    def target(self) -> Array:
        """``q_des`` of the posture task at the last tick, shape (nq,)."""
        self._call("last_report", ctypes.byref(self._report))
        return self._diagnosis["target"].copy()

    @property
    def flow_failures(self) -> int:
        """Number of steps since the reset for which the solver of the reference flow failed."""
        self._call("last_report", ctypes.byref(self._report))
        return int(self._report.flow_failures)

    def brace(self, t: float = -math.inf, *, t_impact: float | None = None) -> None:
        """Switch the impact-robust term on, or start the reference flow, at the first tick that is not before ``t``.

        Args:
            t: Time of the switch, s, measured like the times of ticks; by default, the time of the next tick.
            t_impact: Time from ``t`` to the impact, s; ``None`` if it is unknown.  A reference flow comes to rest
                before the impact.

        Raises:
            InputError: This phase cannot follow the present phase, or ``t`` is before the time of a phase that has
                not begun yet.  The same error is raised if ``t_impact`` is not finite, or if the controller has no
                reference flow.
        """
        if t_impact is None:
            self._enter("brace", t)
        elif not math.isfinite(t_impact) or "brace_before" not in self._functions:
            what = "t_impact is not finite, or the controller has no reference flow"
            raise InputError(what, where="brace", hint="give finite seconds, or leave out t_impact")
        else:
            self._enter("brace_before", t, t_impact)

    def contact(self, t: float = -math.inf) -> None:
        """Hold the reached posture during the impact, or, if ``activation.live``, keep the impact-robust term on.

        ``t`` has the same meaning as in :meth:`brace`.
        """
        self._enter("contact", t)

    def release(self, t: float = -math.inf) -> None:
        """Switch the impact-robust term or the flow off, and make the reached posture the target.

        ``t`` has the same meaning as in :meth:`brace`.
        """
        self._enter("release", t)

    @property
    def level(self) -> float:
        """Level of the impact-robust term, 0 to 1; for a reference flow, 1 if it may move and 0 if not."""
        return float(self._level[0])

    def _enter(self, function: str, *times: float) -> None:
        if self._call(function, *map(ctypes.c_double, times)):
            what = f"'{function.partition('_')[0]}' at {times[0]:g} s does not follow the phase before it"
            raise InputError(what, where="controller", hint="give phases in the order of their times, or call reset")

    def _call(self, name: str, *arguments: Any) -> int:
        return int(self._functions[name](self._context, *arguments))

    def _commanded(self) -> Command:
        sizes, out = self._checked.sizes, self._out
        u, rotors = out["u"][: sizes["CONTROLS"]].copy(), sizes["ROTORS"]
        status = STATUSES[self._command.status]
        speeds, forces = out["rotor_speed"][:rotors].copy(), out["forces"][: sizes["FORCES"]].copy()
        return Command(u, u[rotors:], speeds, status, out["acceleration"].copy(), forces)


def _shaped(values: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    array = np.asarray(values, dtype=float, order="C")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, not {shape}")
    return array


def _pointer(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def _structure(arrays: list[tuple[str, int]], integers: list[str]) -> tuple[Any, dict[str, Array]]:
    """Return a C structure with arrays of doubles, then single integers, and NumPy views of its arrays by name."""
    fields = [(name, ctypes.c_double * size) for name, size in arrays]
    kind = type("Block", (ctypes.Structure,), {"_fields_": [*fields, *((name, ctypes.c_int) for name in integers)]})
    block = kind()
    return block, {name: np.frombuffer(getattr(block, name), dtype=float) for name, _ in arrays}
