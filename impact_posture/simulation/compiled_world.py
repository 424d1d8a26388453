"""Simulation loop in C, which calls MuJoCo and the exported C controller in every tick."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impact_posture.controller_export.compiled_controller import TARGET
from impact_posture.errors import CompilerError
from impact_posture.simulation.controllers.compiled_tick import CompiledTick
from impact_posture.simulation.scenario_objective import locked
from impact_posture.simulation.world.actuator_command import ActuatorCommand, Trace
from impact_posture.simulation.world.world import World
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import (
    build_library,
    cache_folder,
    is_cached,
    library_path,
    load_library,
    source_key,
)
from impact_posture.system.optional_package import import_mujoco, unwarned

_NAME = "world_ticks"
# Maximum number of propellers in the C loop.
_ROTORS = 64
# Compiler options that define constants of the C loop.
_DEFINED = (f"-DROTORS={_ROTORS}", f"-DTARGET={TARGET}")


class Ticks(NamedTuple):
    """Record of n ticks.

    Attributes:
        trace: True states after the ticks.
        rotor_speed: Rotor commands, shape (n, rotors).
        level: Activation levels with which the controller prepares for an impact, 0 to 1, shape (n,).
        status: Status numbers of the controller, shape (n,).
    """

    trace: Trace
    rotor_speed: Array
    level: Array
    status: Array


class CompiledWorld:
    """Loop in C of a world and its controller.

    The loop gives the same results as :class:`World` and :class:`CompiledTick`, except for rounding errors.
    :meth:`World.push` and :meth:`World.throw` still work between calls of :meth:`take`.  Before you call other
    methods of the world, call :meth:`World.reset`, because the loop updates only the time.
    """

    def __init__(self, world: World, tick: CompiledTick, contents: dict[str, Any], library: ctypes.CDLL) -> None:
        self._world, self._tick, self._run = world, tick, library.world_ticks
        self._members, self._arrays = _members(), dict[str, Array]()
        kinds = {"int": ctypes.c_int, "double": ctypes.c_double}
        fields = [(name, kinds.get(kind, ctypes.c_void_p)) for name, kind in self._members.items()]
        self._struct = type("World", (ctypes.Structure,), {"_fields_": fields})()
        self._give(**_functions(), **tick.library.addresses(), **contents)

    def _command(self) -> ActuatorCommand:
        struct = self._struct
        places = (struct.u, struct.rotors + struct.joints), (struct.rotor_speed, struct.rotors)
        u, speed = (np.array((ctypes.c_double * size).from_address(address)) for address, size in places)
        return ActuatorCommand(u[struct.rotors :], speed)

    def _give(self, **values: Any) -> None:
        for name, value in values.items():
            if isinstance(value, int | float):
                setattr(self._struct, name, value)
            else:
                kind = np.intc if self._members[name] == "int *" else np.double
                self._arrays[name] = np.array(value, dtype=kind, order="C")
                setattr(self._struct, name, self._arrays[name].ctypes.data)

    def take(self, n: int, lead: Callable[[float], None]) -> Ticks:
        """Run n ticks, or fewer if the state diverges.  ``lead(t)`` sets the task targets for the tick at time t, s.

        Raises:
            InputError: A command is not finite, or the torque of a joint without limit is too large.
        """
        world, struct = self._world, self._struct
        times = [(struct.steps + k * struct.count) * struct.timestep for k in range(n)]
        led, leads = self._tick.plan(times, lead)
        self._give(led=led, lead=leads, **world.next_in_c(n))
        each, rotors = (struct.shapes,), (struct.rotors,)
        shapes = {"t": (), "q": (struct.nq,), "v": (struct.nv,), "rotor_speeds": rotors, "torques": (struct.joints,),
                  "qpos": (struct.nqpos,), "touching": each, "force": (*each, 3), "impulse": (*each, 3), "peak": each,
                  "began": each, "slip": each, "command": rotors, "level": (), "status": ()}  # fmt: skip
        self._give(**{f"row_{name}": np.zeros((n, *shape)) for name, shape in shapes.items()})
        with unwarned():
            done = int(self._run(ctypes.byref(struct), n))
        world.go_to(struct.steps)
        if struct.refused:
            world.limits.within(self._command())
        row: dict[str, Any] = {name: self._arrays[f"row_{name}"][:done] for name in shapes}
        row["stopped"], row["touching"] = world.stops.reached(row["qpos"]), row["touching"] > 0
        row["began"] = np.where(np.isinf(row["began"]), np.nan, row["began"])
        return Ticks(Trace(*(row[name] for name in Trace._fields)), row["command"], row["level"], row["status"])


def compiled_world(world: World, tick: CompiledTick | None, count: int) -> CompiledWorld | None:
    """Return the C loop for a world after its reset, or ``None`` if Python must run the ticks.

    Python runs the ticks without a C controller, and if the loop cannot be compiled (for example, without MuJoCo
    headers).  Python also runs worlds with more than 64 rotors and worlds that :meth:`World.in_c` excludes.
    """
    contents = None if tick is None else world.in_c(count)
    if tick is None or contents is None or contents["rotors"] > _ROTORS:
        return None
    try:
        library = _library()
    except CompilerError:
        return None
    return None if library is None else CompiledWorld(world, tick, contents, library)


@cache
def _members() -> dict[str, str]:
    """Return member name → type of the C struct, in the order of the members."""
    struct = re.sub(r"/\*.*?\*/", "", _source(), flags=re.DOTALL).partition("typedef struct {")[2].partition("}")[0]
    members = {}
    for declaration in filter(None, map(str.strip, struct.split(";"))):
        if function := re.search(r"\(\*(\w+)\)\(", declaration):
            members[function[1]] = "function"
            continue
        kind, names = declaration.removeprefix("const ").split(maxsplit=1)
        for name in map(str.strip, names.split(",")):
            members[name.lstrip("*")] = f"{kind} *" if name.startswith("*") else kind
    return members


@cache
def _source() -> str:
    return (resources.files(__package__) / "c" / f"{_NAME}.c").read_text(encoding="utf-8")


@cache
def _functions() -> dict[str, int]:
    library = ctypes.CDLL(str(next(Path(import_mujoco().__file__).parent.glob("libmujoco.*"))))
    names = {"step1": library.mj_step1, "step2": library.mj_step2, "apply": library.mj_applyFT}
    return {name: ctypes.cast(function, ctypes.c_void_p).value or 0 for name, function in names.items()}


def _library() -> ctypes.CDLL | None:
    """Load the loop; build it first if it is not in the cache.  Return ``None`` if the MuJoCo headers are missing."""
    headers = Path(import_mujoco().__file__).parent / "include"
    if not (headers / "mujoco" / "mujoco.h").is_file():
        return None
    folder = cache_folder("worlds", source_key([str(import_mujoco().__version__), *_DEFINED, _source()]))
    library = library_path(folder, _NAME)
    with locked(folder.with_suffix(".lock")):
        if not is_cached(library):
            (folder / f"{_NAME}.c").write_text(_source(), encoding="utf-8")
            build_library(folder, _NAME, flags=["-isystem", str(headers), *_DEFINED])
    return load_library(library)
