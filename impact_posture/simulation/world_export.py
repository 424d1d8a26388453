"""Export of the world of a scenario for programs in other languages: the MuJoCo model and its parameters.

``world.xml`` is the readable model, with numbers of six digits.  ``world.mjb`` is the exact binary model, which only
the same version of MuJoCo can load.  ``world.txt`` has one line per parameter: a key and its numbers.
``docs/examples/cpp/closed_loop`` reads ``world.mjb`` and ``world.txt``.  The exported sensors have the delay and the
force filter of the scenario, but no noise.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import point_on
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.metrics import JUMP
from impact_posture.simulation.run import BRACE
from impact_posture.simulation.scenario_file import RepeatedContacts, SinglePush
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.throw import Throw
from impact_posture.system.optional_package import import_mujoco
from impact_posture.system.output_folder import whole_folder

MODEL, PARAMETERS = "world.mjb", "world.txt"


def export_world(setup: Setup, out: Path, *, force: bool = False) -> None:
    """Write ``world.xml``, ``world.mjb`` and ``world.txt`` of a scenario.

    Raises:
        InputError: The scenario throws a ball, or a joint is neither revolute, prismatic nor a floating base.
        OutputError: The folder exists and ``force`` is false, contains other files, or cannot be written.
    """
    mujoco, mjcf = import_mujoco(), setup.world.built.mjcf
    model = mjcf.compile()
    lines = [" ".join([key, *map(repr, map(float, values))]) for key, values in _parameters(setup, model)]
    with whole_folder(out, force=force, kind="world") as folder:
        (folder / "world.xml").write_text(mjcf.spec.to_xml(), encoding="utf-8")
        # Python writes the file, because MuJoCo cannot open a file whose path is not UTF-8.
        content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        (folder / MODEL).write_bytes(content.tobytes())
        (folder / PARAMETERS).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _parameters(setup: Setup, model: Any) -> Iterable[tuple[str, Iterable[float]]]:
    scenario, robot, built = setup.scenario, setup.robot, setup.world.built
    sensors, step, control = scenario.sensors, scenario.physics.timestep, scenario.control
    yield "timestep", [step]
    yield "period", [control.period]
    yield "brace", [BRACE]
    yield "jump", [JUMP]
    yield "q", setup.q
    yield from _joints(setup)
    yield "effort", setup.world.limits.effort
    yield "shapes", [model.geom(name).id for names in built.shape_geoms for name in names]
    yield "shape_of", [k for k, names in enumerate(built.shape_geoms) for _ in names]
    propulsion = robot.spec.propulsion
    if propulsion is not None:
        shares = -np.expm1(-step / np.array([propulsion.time_constant_up, propulsion.time_constant_down]))
        yield "rotors", [len(propulsion.rotors)]
        yield "rotor_law", [*shares, propulsion.thrust_coefficient, propulsion.speed_min, propulsion.speed_max]
    yield "delay", [round(sensors.delay / step)]
    if sensors.force_frame is not None:
        frames = [shape.frame for shape in scenario.shapes]
        yield "force_shape", [frames.index(sensors.force_frame)]
        yield "force_smoothing", [-np.expm1(-2 * np.pi * sensors.force_cutoff * step)]
    yield from _task(setup, model)


def _joints(setup: Setup) -> Iterable[tuple[str, Iterable[float]]]:
    """Yield the indices of each joint in q, qpos, v and qvel.  A floating base has the key ``base``."""
    for slot in setup.world.built.mjcf.layout.slots:
        family = slot.joint.kind.family
        indices = [slot.joint.q.start, slot.qpos.start, slot.joint.v.start, slot.qvel.start]
        if family == "free-flyer" and not slot.moved and slot.qpos.stop - slot.qpos.start == 7:
            yield "base", indices
        elif family in ("revolute", "prismatic"):
            yield "joint", indices
        else:
            what = f"joint '{slot.joint.name}' is of the family {family}"
            raise InputError(what, where="world export", hint="lock the joint (lock = [...] in the scenario)")


def _task(setup: Setup, model: Any) -> Iterable[tuple[str, Iterable[float]]]:
    scenario, task = setup.scenario, setup.scenario.task
    if isinstance(task, Throw):
        raise InputError(
            "a thrown ball cannot be exported", where=scenario.source, hint="use a scenario with contacts or a push"
        )
    if scenario.falls:
        raise InputError("a fall cannot be exported", where=scenario.source, hint="use contacts without others")
    if isinstance(task, RepeatedContacts):
        reference = Reference(task, setup.gap)
        yield "touching", [[shape.frame for shape in scenario.shapes].index(task.frame)]
        yield "inward", -scenario.normal
        yield "contacts", [task.count, task.settle, task.dwell, task.window, reference.inward, reference.cycle]
        yield "crossing", [reference.crossing]
        for leg in reference.legs:
            yield "leg", leg
    elif isinstance(task, SinglePush):
        point = point_on(setup.robot, task.frame)
        body = model.body(setup.world.built.mjcf.bodies[point.joint]).id
        yield "push", [body, *point.position, *task.force, task.duration]
        yield "rest", [max(task.settle, BRACE + scenario.control.period), task.quiet, task.still, task.patience]
        yield "after", [task.after]
