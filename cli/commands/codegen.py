"""``impact-posture codegen ROBOT --frame F --normal X Y Z`` or ``impact-posture codegen RESULT_DIR``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from impact_posture.settings import ImpactSettings
from impact_posture_cli import options
from impact_posture_cli.controller_code import write_controller
from impact_posture_cli.error_boundary import UsageError
from impact_posture_cli.output import Page, print_json
from impact_posture_cli.progress_line import progress
from impact_posture_cli.settings_options import Given, with_settings

if TYPE_CHECKING:
    from impact_posture.impact.objective import ImpactObjective

_IMPACT = {"speed", "restitution", "posture"}


@with_settings(ImpactSettings, without=_IMPACT, frame=options.FrameList)
def codegen(
    given: Given,
    robot: options.RobotOrResult,
    prefix: options.Prefix = None,
    out: options.ExportOut = None,
    float_: options.Float = False,
    portable: options.Portable = False,
    compile: options.CompileLibrary = False,
    controller: options.ControllerKind = None,
    flow: options.ControllerFlow = False,
    scenario: options.ControllerScenario = None,
    daqp: options.Daqp = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Run ``impact-posture codegen``."""
    from_result = given.is_result(robot, {"prefix", "out", "float_", "portable", "compile", "force"})
    if controller is not None:
        if float_ or portable:
            raise UsageError("--controller is double and plain C99: leave --float and --portable out.")
        write_controller(
            given, robot, controller, flow=flow, scenario=scenario, daqp=daqp, prefix=prefix, out=out,
            build=compile, force=force, json=json, quiet=quiet,
        )  # fmt: skip
        return
    if flow or scenario is not None or daqp is not None:
        raise UsageError("--flow, --scenario and --daqp belong to --controller: give aerial, legged or arm.")
    if not from_result:
        _check_problem(given, robot)
    from impact_posture.codegen.export import write_export

    posture = squeezed = None
    objectives: list[ImpactObjective]
    warnings: tuple[str, ...] = ()
    if from_result:
        from impact_posture.result_view import load_view

        view = load_view(Path(robot))
        objectives, posture = [view.objective], view.q_optimal
    else:
        from impact_posture.impact.contact_compression import compression
        from impact_posture.impact.resolved_impact import resolve

        objectives = []
        for frame in given.values.get("frame", (None,)):
            impact = resolve(given.fill(ImpactSettings, robot=robot, frame=frame))
            objectives.append(impact.objective)
            squeezed = squeezed or compression(impact.objective, impact.q, impact.speed, impact.contact_stiffness)
            warnings = impact.warnings
    with progress("writing and compiling" if compile else "writing", shown=not (quiet or json)):
        written = write_export(
            objectives,
            Path(out) if out else None,
            prefix=prefix,
            posture=posture,
            compression=squeezed,
            single=float_,
            portable=portable,
            build=compile,
            force=force,
        )
    if json:
        print_json(written.to_dict())
        return
    page = Page(quiet=quiet)
    page.warnings(warnings)
    where = ", ".join(contact.frame for o in objectives for contact in o.contacts)
    page.title(f"{objectives[0].robot.name} at {where}", f"objective {objectives[0].name}")
    page.pairs(
        [
            ("folder", str(written.out)),
            ("functions", ", ".join(written.functions)),
            ("posture", "the result's optimum" if posture is not None else "none"),
            ("numbers", written.manifest["real"]),
            ("stack", f"at most {written.manifest['stack_bytes']} bytes"),
        ]
    )
    page.line(written.verdict)


def _check_problem(given: Given, robot: str) -> None:
    """Check that there is a contact. Without one, a folder or a path to one is meant as a result folder."""
    if not {"contact", "normal"} & given.values.keys() and (Path(robot).is_dir() or robot.endswith(os.sep)):
        from impact_posture.result_view import load_view
        from impact_posture.robot.robot_loader import known_robots

        if robot not in known_robots():
            load_view(Path(robot))
    given.check_contact()
