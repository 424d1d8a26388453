"""``impact-posture simulate SCENARIO --controller C``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from impact_posture.config.demand import Positive
from impact_posture.errors import SimulationDiverged
from impact_posture_cli import options
from impact_posture_cli.experiments import RUN, Compile, Mode, ScenarioName
from impact_posture_cli.output import Page, complain, number, print_json
from impact_posture_cli.settings_options import demanding

if TYPE_CHECKING:
    from impact_posture.simulation.scenario_file import Scenario

Controller = Annotated[
    str,
    options.option(
        "--controller", RUN,
        "nominal, robust, robust-speed, robust-sticking, robust-release, robust-flow, robust-flow-sticking, "
        "posture, posture-sticking, path, strike, stiff, posture-stiff, invariant, walker, reference-spreading, "
        "impact-aware, or the name that an installed package has registered.",
    ),
]  # fmt: skip
RunSeed = Annotated[
    int, options.option("--seed", RUN, "Seed of the sensor noise and of [spread] in the scenario.", min=0)
]
RunMode = Annotated[
    Mode,
    options.option("--mode", RUN, "In the impact: keep the impact-robust term (live), or hold the posture (held)."),
]
Free = Annotated[bool, options.option("--free", RUN, "Compute gradient and optimum without the feet on the ground.")]
Gain = Annotated[
    float | None,
    options.option(
        "--gain", RUN, "Gain K of the impact-robust term, 1/s².", callback=demanding(Positive),
        show_default="the scenario's",
    ),
]  # fmt: skip
Sign = Annotated[
    Literal["+1", "1", "-1"] | None, options.option("--sign", RUN, "Sign of the push.", show_default="both")
]
ExportWorld = Annotated[
    str | None,
    options.option("--export-world", RUN, "Write the world for C++ programs, and run nothing.", metavar="DIR"),
]
Out = Annotated[
    str | None, options.out_option("Folder for run.json, the time series and the figures.", "./SCENARIO-CONTROLLER")
]


def simulate(
    scenario: ScenarioName,
    controller: Controller = "nominal",
    seed: RunSeed = 0,
    mode: RunMode = "live",
    free: Free = False,
    gain: Gain = None,
    sign: Sign = None,
    compile: Compile = "auto",
    export_world: ExportWorld = None,
    out: Out = None,
    force: options.Force = False,
    format: options.Formats = None,
    no_report: options.NoReport = False,
    meshes: options.Meshes = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    from impact_posture.simulation.scenario_file import read_scenario

    # Read the scenario before the slow imports, so that a wrong name is reported at once.
    experiment = read_scenario(scenario)
    from impact_posture.experiment.experiment_folders import Output, write_simulation
    from impact_posture.experiment.jobs import Job, controller_factory, execute, worth_compiling
    from impact_posture.experiment.seed_statistics import fate
    from impact_posture.output.picture_formats import DEFAULT_FORMATS
    from impact_posture.posture.program.ipopt import one_blas_thread
    from impact_posture.simulation.controllers.controller_factory import check_gain
    from impact_posture.system.escape import file_name
    from impact_posture.system.output_folder import check_output

    page = Page(json=json, quiet=quiet)
    if export_world is not None:
        _export_world(page, experiment, Path(export_world), force)
        return
    check_gain(controller, gain)
    only, code = None if sign is None else int(sign), worth_compiling(compile, 1)
    job = Job(scenario, controller, seed, mode, free, gain, only, code)
    folder = Path(out) if out else Path(file_name(f"{experiment.name}-{job.label.replace(':', '-')}"))
    check_output(folder, force=force, kind="run")
    with page.progress("preparing"):
        factory = controller_factory(job.scenario, job.free)
    page.warnings(factory.setup.warnings)
    with page.progress("running"):
        with one_blas_thread():
            runs, document = execute(job, factory)
        output = Output(folder, force, format or DEFAULT_FORMATS, not no_report, meshes)
        failure = write_simulation(output, job, runs, document)
    page.warnings([failure and f"there is no report.html: {failure}"])
    if json:
        print_json(document)
    else:
        # The first warnings concern the scenario.  They are not printed again, because they were printed before the
        # run.
        _show(page, document, job.label, folder, document["warnings"][len(factory.setup.warnings) :])
    if document["status"] != "completed":
        sys.stdout.flush()
        complain(f"error: {experiment.name}, {job.label}: {fate(document)}; do not use its numbers")
        raise typer.Exit(SimulationDiverged.exit_code)


def _export_world(page: Page, scenario: Scenario, out: Path, force: bool) -> None:
    from impact_posture.simulation.setup import set_up
    from impact_posture.simulation.world_export import export_world
    from impact_posture.system.output_folder import check_output

    check_output(out, force=force, kind="world")
    export_world(set_up(scenario), out, force=force)
    if page.json:
        print_json({"schema": "impact-posture/world/1", "folder": str(out)})
    else:
        page.line(f"written: {out}; its sensors have no noise")


def _rigid(prediction: dict[str, Any]) -> str:
    if prediction["coulomb"] is None:
        return f"{number(prediction['frictionless'], missing='–')} without a controller"
    named = {
        "frictionless": "without friction",
        "coulomb": "with the friction of the surface",
        "sticking": "sticking",
    }
    return ", ".join(f"{number(prediction[key], missing='–')} {words}" for key, words in named.items())


def _show(page: Page, document: dict[str, Any], label: str, folder: Path, notes: list[str]) -> None:
    from impact_posture.experiment.run_report_content import load_rows

    page.title(f"{document['scenario']}, {label}", f"seed {document['seed']}")
    runs = document["runs"]
    rows = [("status", document["status"])]
    if document["metrics"] is not None:
        rows += _numbers(document["metrics"], document["prediction"])
    counted = ("relaxed_ticks", "failed_ticks", "contacts", "contacts_asked")
    count = {key: sum(part["metrics"][key] for part in runs) for key in counted}
    ticks = sum(part["ticks"] for part in runs)
    rows += [
        ("relaxed", f"{count['relaxed_ticks']} of {ticks} ticks, in which limits made a task give way"),
        ("held", f"{count['failed_ticks']} ticks without a new command, in which the last command was kept"),
    ]
    if any(window["kind"] == "dwell" for window in document["windows"]):
        rows.append(("contacts", f"{count['contacts']} of {count['contacts_asked']}"))
    page.pairs(rows)
    if document["prediction"] is not None and (loads := load_rows(document["prediction"])):
        page.gap()
        head = ("  in the impact", "measured", "rigid prediction", "unit")
        page.table(head, [(f"  {row[0]}", *row[1:-1]) for row in loads], right=(1, 2))
    if len(runs) > 1 and document["metrics"] is not None:
        page.gap()
        parts = [
            (f"  {part['sign']:+d}", number(part["metrics"]["q_total_impact"]), number(part["metrics"]["peak_jump"]),
             number(part["waited"]))
            for part in runs
        ]  # fmt: skip
        page.table(("  push", "q_total_impact", "peak jump", "pushed after s"), parts, right=(1, 2, 3))
    if document["events"]:
        page.gap()
        for event in document["events"]:
            which = f" (push {event['sign']:+d})" if len(runs) > 1 else ""
            page.line(f"  t = {event['time']:.2f} s: {event['status']}{which}: {event['what']}")
    page.gap()
    notes += [document[key] and document[key][note] for key, note in (("offline", "note"), ("path", "reason"))]
    if document["metrics"] is not None and not document["metrics"]["rested"]:
        notes.append("the robot was not at rest before the push: the numbers include its own motion")
    page.warnings(notes)
    page.line(f"written: {folder}")


def _numbers(metrics: dict[str, Any], prediction: dict[str, Any]) -> list[tuple[str, str]]:
    from impact_posture.simulation.metrics import UNTIL_RECOVERY

    saturation = metrics["saturation_s"]
    joints = f"base {number(metrics['q_total_impact_base'])}, joints {number(metrics['q_total_impact_joints'])}"
    rows = [("q_total_impact", f"{number(metrics['q_total_impact'])}  ({joints}; rad, mixed with m)")]
    restitution = [] if prediction["restitution"] is None else [
        ("restitution", f"{number(prediction['restitution'])} from the contact law, used in the predicted jump")
    ]  # fmt: skip
    if metrics["q_total_dwell"]:
        rows.append(("q_total_dwell", number(metrics["q_total_dwell"])))
    return [
        *rows,
        ("q_total_recovery", f"{number(metrics['q_total_recovery'])}, {UNTIL_RECOVERY}"),
        (
            "peak jump",
            f"{number(metrics['peak_jump'])} in the mean, {number(metrics['peak_jump_max'])} at most (rad/s, m/s)",
        ),
        ("peak, recovery", number(metrics["peak_recovery"])),
        ("predicted jump", _rigid(prediction)),
        *restitution,
        ("H before", number(prediction["H"], missing="–")),
        ("peak force", f"{number(metrics['peak_force'])} N"),
        ("saturated", f"{number(saturation['inside'])} s in the windows, {number(saturation['outside'])} s outside"),
        *([("at stops", ", ".join(metrics["stops"]))] if metrics["stops"] else []),
    ]
