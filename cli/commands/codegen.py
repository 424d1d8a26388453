"""``impact-posture codegen ROBOT --frame F --normal X Y Z`` or ``impact-posture codegen RESULT_DIR``.

With ``--controller KIND``, the command writes the complete online controller instead of the metric alone.  From a
result with a path, the command also writes the references along the path.
"""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from impact_posture.config.problem_settings import ImpactSettings, LoadOptions, RobotSettings
from impact_posture_cli import options
from impact_posture_cli.error_boundary import UsageError
from impact_posture_cli.output import Page, print_json
from impact_posture_cli.settings_options import TypedSettings, with_settings

if TYPE_CHECKING:
    from impact_posture.codegen.export import Export
    from impact_posture.controller_export.default_formulation import ControllerKind
    from impact_posture.controller_export.export_controller import ControllerExport
    from impact_posture.impact.elasticity.contact_compression import Compression
    from impact_posture.impact.worst_case_objective import WorstCaseObjective
    from impact_posture.path.posture_path import PosturePath
    from impact_posture.robot.robot import Robot
    from impact_posture.system.arrays import Array
    from impact_posture.tsid.task_formulation import TaskFormulation

_IMPACT = {"speed", "restitution", "posture"}


@with_settings(ImpactSettings, without=_IMPACT, frame=options.FrameList)
def codegen(
    typed: TypedSettings,
    robot: options.RobotOrResult,
    prefix: options.Prefix = None,
    out: options.ExportOut = None,
    float_: options.Float = False,
    portable: options.Portable = False,
    cuda: options.Cuda = False,
    compile: options.CompileLibrary = False,
    controller: options.ControllerKind = None,
    flow: options.ControllerFlow = False,
    scenario: options.ControllerScenario = None,
    daqp: options.Daqp = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    free = {"prefix", "out", "float_", "portable", "cuda", "compile", "controller", "flow", "daqp", "force"}
    from_result = typed.is_result(robot, free)
    if controller is None:
        if flow or scenario is not None or daqp is not None:
            what = "--flow, --scenario and --daqp belong to --controller"
            raise UsageError(f"{what}: give --controller aerial, legged or arm.")
        if not from_result:
            _check_problem(typed, robot)
    elif float_ or portable or cuda:
        raise UsageError("--controller always writes C99 with double: leave --float, --portable and --cuda out.")
    page, warnings = Page(json=json, quiet=quiet), tuple[str, ...]()
    written: ControllerExport | Export
    place = Path(out) if out else None
    if controller is not None:
        from impact_posture.controller_export.export_controller import export_controller

        made, formulation, objective, motion = (
            _result_parts(robot, controller, flow)
            if from_result
            else (*_controller_parts(typed, robot, controller, flow, scenario), None)
        )
        written = export_controller(
            made, formulation, place, objective=objective, prefix=prefix, daqp=daqp,
            build=compile, force=force, path=motion,
        )  # fmt: skip
        posture = "nominal posture" if objective is None else "reference flow" if flow else "impact-robust"
        title = f"{made.name}, {controller}", posture
        tasks = ", ".join(task["name"] for task in written.manifest["tasks"])
        rows = [("tasks", tasks), ("header", f"{written.prefix}.h")]
        rows += [("path", f"{written.prefix}_path.h")] if motion is not None else []
    else:
        from impact_posture.codegen.export import write_export

        objectives, optimum, squeezed, warnings, choice = _objectives(typed, robot, from_result)
        with page.progress("writing and compiling" if compile else "writing"):
            written = write_export(
                objectives, place, prefix=prefix, posture=optimum, compression=squeezed, single=float_,
                portable=portable, cuda=cuda, build=compile, force=force,
            )  # fmt: skip
        where = ", ".join(contact.frame for o in objectives for contact in o.contacts)
        title = f"{objectives[0].robot.name} at {where}", f"objective {objectives[0].name}"
        rows = [
            ("functions", ", ".join(written.functions)),
            ("posture", "of the result" if optimum is not None else "none"),
            ("numbers", written.manifest["real"]),
            ("stack", f"at most {written.manifest['stack_bytes']} bytes"),
            *([("choice", choice)] if choice else []),
        ]
    if json:
        print_json(written.to_dict())
        return
    page.warnings(warnings)
    page.title(*title)
    page.pairs([("folder", str(written.out)), *rows])
    page.line(written.verdict)


def _check_problem(typed: TypedSettings, robot: str) -> None:
    """Check that a contact is given.

    If no contact is given and ``robot`` is a folder, the user probably means a result folder, so the error states why
    the folder is not a result.
    """
    if not {"contact", "normal"} & typed.values.keys() and (os.path.isdir(robot) or robot.endswith(os.sep)):
        from impact_posture.output.result_reader import load_view
        from impact_posture.robot.robot_loader import known_robots

        if robot not in known_robots():
            load_view(Path(robot))
    typed.check_contact()


def _objectives(
    typed: TypedSettings, robot: str, from_result: bool
) -> tuple[list[WorstCaseObjective], Array | None, Compression | None, tuple[str, ...], str]:
    """Return objectives, optimal posture of a result, compression, warnings, and the reason for ``auto``."""
    if from_result:
        from impact_posture.output.result_reader import load_view

        view = load_view(Path(robot))
        return [view.objective], view.q_optimal, None, (), ""
    from impact_posture.impact.elasticity.contact_compression import compression
    from impact_posture.impact.resolved_impact import resolve

    frames = typed.values.get("frame", (None,))
    impacts = [resolve(typed.fill(ImpactSettings, robot=robot, frame=frame)) for frame in frames]
    known = (compression(one.objective, one.q, one.speed, one.contact_stiffness) for one in impacts)
    last = impacts[-1]
    return [one.objective for one in impacts], None, next(filter(None, known), None), last.warnings, last.choice


def _result_parts(
    folder: str, kind: ControllerKind, flow: bool
) -> tuple[Robot, TaskFormulation, WorstCaseObjective, PosturePath | None]:
    """Return the robot of a result, its task formulation, its objective, and the path that its controller follows.

    The path is ``None`` with a reference flow, or if the robot stays at its start.
    """
    from impact_posture.controller_export.default_formulation import default_formulation
    from impact_posture.output.result_reader import load_view

    view = load_view(Path(folder))
    objective, motion = view.objective, view.motion
    formulation = default_formulation(objective.robot, kind, objective, flow=flow)
    moves = motion is not None and len(motion.t) > 1 and not flow
    return objective.robot, formulation, objective, motion if moves else None


def _controller_parts(
    typed: TypedSettings, robot: str, kind: ControllerKind, flow: bool, scenario: str | None
) -> tuple[Robot, TaskFormulation, WorstCaseObjective | None]:
    """Return the robot, its task formulation, and the objective of the posture task; ``None`` for no objective."""
    if scenario is not None:
        from impact_posture.simulation.controllers.controller_factory import ControllerFactory
        from impact_posture.simulation.scenario_file import read_scenario
        from impact_posture.simulation.scenario_objective import interpreted
        from impact_posture.simulation.setup import set_up

        if typed.values:
            what = f"--{next(iter(typed.values))} contradicts --scenario, which sets robot and impact"
            raise UsageError(f"{what}: leave it out.")
        setup = set_up(read_scenario(scenario))
        known = {setup.robot.name, setup.robot.source}
        if robot not in known and Path(robot).resolve() != Path(setup.robot.source).resolve():
            raise UsageError(f"The scenario {scenario} has another robot than {robot}: give {setup.robot.name}.")
        factory = ControllerFactory(setup, gradient_of=interpreted)
        driver = factory.driver("robust-flow" if flow else "robust")
        return setup.robot, driver.controller.formulation, factory.objective()
    from impact_posture.controller_export.default_formulation import default_formulation

    if "normal" in typed.values:
        from impact_posture.impact.resolved_impact import resolve

        frames = typed.values.get("frame", (None,))
        if len(frames) > 1:
            raise UsageError("--controller can follow the gradient of only one impact: give one --frame.")
        objective = resolve(typed.fill(ImpactSettings, robot=robot, frame=frames[0])).objective
        return objective.robot, default_formulation(objective.robot, kind, objective, flow=flow), objective
    from impact_posture.robot.robot_loader import load_robot

    if flow:
        raise UsageError("--flow requires an impact: give --normal X Y Z, or --scenario.")
    known = {field.name for field in fields(LoadOptions)}
    for name in typed.values:
        if name not in known:
            raise UsageError(f"--{name.replace('_', '-')} belongs to an impact: give --normal X Y Z too.")
    loaded = load_robot(robot, typed.fill(RobotSettings, robot=robot))
    return loaded, default_formulation(loaded, kind), None
