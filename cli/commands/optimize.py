"""``impact-posture optimize ROBOT --frame F --normal X Y Z`` or ``impact-posture optimize PROBLEM.toml``."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from impact_posture.config.problem_settings import JOBS, ProblemSettings
from impact_posture_cli import options
from impact_posture_cli.optimize_summary import announce, summarize
from impact_posture_cli.output import Page, print_json
from impact_posture_cli.settings_options import TypedSettings, with_settings

if TYPE_CHECKING:
    from impact_posture.output.result_folder import Written

# Thresholds of the garbage collector, which are so high that the garbage collector rarely runs.
_RARELY = 200_000, 50, 100

RobotOrProblem = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|PROBLEM.toml",
        help="Robot as in 'robots': name, file or COLLECTION:NAME; or a problem.",
    ),
]


@with_settings(ProblemSettings)
def optimize(
    typed: TypedSettings,
    robot: RobotOrProblem,
    jobs: options.Jobs = JOBS,
    compile: options.Compile = "auto",
    out: options.Out = None,
    force: options.Force = False,
    no_codegen: options.NoCodegen = False,
    format: options.Formats = None,
    no_report: options.NoReport = False,
    meshes: options.Meshes = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    # Garbage collection would take time without freeing memory, because most objects are used until the end.
    gc.set_threshold(*_RARELY)
    settings = _settings(robot, typed)
    _refuse_idle(typed, settings)
    from impact_posture.api.posture_problem import PostureProblem
    from impact_posture.api.posture_result import optimize as solve
    from impact_posture.output.picture_formats import DEFAULT_FORMATS
    from impact_posture.output.result_folder import default_out
    from impact_posture.posture.formulation.problem_file import dump_settings, prepare, resolved_settings
    from impact_posture.system.output_folder import check_output

    if settings.path:
        from impact_posture.path.posture_path import check_package

        check_package()
    page = Page(json=json, quiet=quiet)
    # For a large robot, fitting the collision shapes takes several seconds, unless they are in the cache.
    with page.progress("preparing"):
        prepared = prepare(settings)
    if settings.strike:
        from impact_posture.path.strike import check_strike

        check_strike(prepared.problem, prepared.impact.speed)
    if not no_codegen:
        prepared.impact.objective.check_expressions()
    folder = Path(out) if out else default_out(prepared)
    check_output(folder, force=force, kind="result")
    # Check before the search that TOML allows all names, so that the result can be written afterwards.
    dump_settings(resolved_settings(prepared))
    announce(page, prepared)
    with page.progress("solving", "starts", first="building the expressions") as advance:
        result = solve(
            PostureProblem.of(prepared),
            starts=settings.starts,
            seed=settings.seed,
            jobs=jobs,
            compile=compile,
            search=settings.search,
            progress=advance,
            # If no path reaches the best optimum, the next best optimum is used.  Therefore, search all optima.
            finish_all=settings.finish_all or settings.path,
        )
    if settings.tradeoff:
        with page.progress("solving", "points") as advance:
            result = result.trade_off(settings.tradeoff, settings.tradeoff_against, compile=compile, progress=advance)
    if settings.path:
        with page.progress("planning", "paths", first="searching a path to the optimum"):
            result = result.path(seed=settings.seed, strike=settings.strike, jobs=jobs)
    if not json:
        # Print the result first, because writing figures and C code takes longer.
        summarize(page, prepared, result.solution, result.document)
    with page.progress("drawing" if no_codegen else "drawing and compiling", "files") as advance:
        written = result.save(
            folder,
            force=force,
            codegen=not no_codegen,
            formats=format or DEFAULT_FORMATS,
            report=not no_report,
            meshes=meshes,
            jobs=jobs,
            progress=advance,
        )
    bare, unreported = written.compiler_error, written.report_error
    page.warnings([bare and f"the C code in c/ is written but could not be built: {bare}"])
    page.warnings([unreported and f"there is no report.html: {unreported}"])
    if json:
        print_json(result.document)
    elif not quiet:
        page.gap()
        page.line(f"written to {written.out}: {_contents(written)}")


def _settings(robot: str, typed: TypedSettings) -> ProblemSettings:
    from_file = robot.endswith((".toml", ".yaml", ".yml"))  # The reader refuses YAML.
    if not from_file and os.path.isfile(problem := Path(robot) / "problem.toml"):
        from impact_posture.robot.robot_loader import known_robots

        if robot not in known_robots():
            what = f"this is a result folder, not a robot; to solve its problem again, give {problem}"
            raise typer.BadParameter(what, param_hint="'ROBOT'")
    if not from_file or "contact" in typed.values:
        typed.check_contact()
    if not from_file:
        return typed.fill(ProblemSettings, robot=robot)
    from impact_posture.posture.formulation.problem_file import read_settings

    return read_settings(Path(robot), typed.values)


def _refuse_idle(typed: TypedSettings, settings: ProblemSettings) -> None:
    """Raise an error for an option that has no effect because another option is missing."""
    for name, used, hint in (
        ("box", settings.contact_pose == "box", "--contact-pose box"),
        ("tradeoff_against", bool(settings.tradeoff), "--tradeoff"),
        ("strike", settings.path, "--path"),
        ("base_box", settings.base == "box", "--base box"),
        ("com_margin", settings.com is not False, "--com"),
        ("hold_force", settings.holdable, "--holdable"),
        ("clearance", settings.collision, "--collision"),
        ("surface", settings.collision, "--collision"),
        ("surface_spread", settings.strike and settings.collision, "--strike and --collision"),
    ):
        if name in typed.values and not used:
            raise typer.BadParameter(f"does nothing without {hint}", param_hint=f"'--{name.replace('_', '-')}'")


def _contents(written: Written) -> str:
    names = "posture.json, result.json, pictures"
    if written.export is None:
        return names
    if written.compiler_error:
        return f"{names}, C code in c/ (not compiled)"
    if written.export.agreement is None:
        return f"{names}, C code in c/ (no compiler here to try it: install gcc or clang, or set CC)"
    return f"{names}, C code in c/ (compiled, agrees to {written.export.agreement:.0e})"
