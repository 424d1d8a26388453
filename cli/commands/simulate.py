"""``impact-posture simulate SCENARIO --controller C``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from impact_posture_cli import options
from impact_posture_cli.checks import positive
from impact_posture_cli.experiments import RUN, Mode, ScenarioName

if TYPE_CHECKING:
    from impact_posture_cli.output import Page

Controller = Annotated[
    str,
    typer.Option(
        "--controller", rich_help_panel=RUN,
        help="nominal, robust, robust-speed, robust-sticking, posture, stiff, invariant or walker.",
    ),
]  # fmt: skip
RunSeed = Annotated[int, typer.Option("--seed", min=0, rich_help_panel=RUN, help="Seed of the sensors' noise.")]
RunMode = Annotated[
    Mode,
    typer.Option(
        "--mode", rich_help_panel=RUN,
        help="live: the term stays on through the blow; held: the reached posture is held before it.",
    ),
]  # fmt: skip
Free = Annotated[
    bool, typer.Option("--free", rich_help_panel=RUN, help="Gradient and optimum of the robot without its feet.")
]
Gain = Annotated[
    float | None,
    typer.Option(
        "--gain", rich_help_panel=RUN, callback=positive, show_default="the scenario's",
        help="K of the impact-robust term, 1/s².",
    ),
]  # fmt: skip
Sign = Annotated[
    Literal["+1", "1", "-1"] | None,
    typer.Option("--sign", rich_help_panel=RUN, show_default="both", help="Which way a robot is pushed."),
]
Out = Annotated[
    str | None,
    typer.Option(
        "--out", metavar="DIR", rich_help_panel=options.OUTPUT, show_default="./SCENARIO-CONTROLLER",
        help="Folder for run.json, the time series and the figures.",
    ),
]  # fmt: skip


def simulate(
    scenario: ScenarioName,
    controller: Controller = "nominal",
    seed: RunSeed = 0,
    mode: RunMode = "live",
    free: Free = False,
    gain: Gain = None,
    sign: Sign = None,
    out: Out = None,
    force: options.Force = False,
    format: options.Formats = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Run a controller through an experiment in MuJoCo; write metrics, time series and figures."""
    from impact_posture.experiment.folders import FORMATS, write_simulation
    from impact_posture.experiment.jobs import Job, execute
    from impact_posture.folder import check_output
    from impact_posture.posture.blas import one_blas_thread
    from impact_posture.simulation.scenario_file import read_scenario
    from impact_posture_cli.output import Page, print_json

    name = read_scenario(scenario).name
    job = Job(scenario, controller, seed, mode, free, gain, None if sign is None else int(sign))
    folder = Path(out) if out else Path(f"{name}-{job.label.replace(':', '-')}".replace("/", "_"))
    check_output(folder, force=force, kind="run")
    with one_blas_thread():
        runs, document = execute(job)
    formats = [f.value for f in format or ()] or FORMATS
    write_simulation(folder, job, runs, document, force=force, formats=formats)
    if json:
        print_json(document)
        return
    _show(Page(quiet=quiet), document, job.label, folder)


def _rigid(prediction: dict[str, Any]) -> str:
    from impact_posture_cli.output import number

    if prediction["sticking"] is None:
        return f"{number(prediction['frictionless'], missing='–')} if nobody controlled"
    return f"{number(prediction['frictionless'])} without friction, {number(prediction['sticking'])} sticking"


def _show(page: Page, document: dict[str, Any], label: str, folder: Path) -> None:
    from impact_posture_cli.output import number

    page.title(f"{document['scenario']}, {label}", f"seed {document['seed']}")
    metrics, prediction = document["metrics"], document["prediction"]
    saturation = metrics["saturation_s"]
    joints = f"base {number(metrics['q_total_impact_base'])}, joints {number(metrics['q_total_impact_joints'])}"
    rows = [
        ("q_total_impact", f"{number(metrics['q_total_impact'])}  ({joints})"),
        ("peak jump", f"{number(metrics['peak_jump'])}, at most {number(metrics['peak_jump_max'])}"),
        ("rigid model", _rigid(prediction)),
        ("H before", number(prediction["H"], missing="–")),
        ("peak force", f"{number(metrics['peak_force'])} N"),
        ("saturated", f"{number(saturation['inside'])} s in the windows, {number(saturation['outside'])} s outside"),
        ("relaxed ticks", f"{metrics['relaxed_ticks']}, held {metrics['failed_ticks']}"),
    ]  # fmt: skip
    if metrics["q_total_dwell"]:
        rows.insert(1, ("q_total_dwell", number(metrics["q_total_dwell"])))
        rows.append(("contacts", f"{metrics['contacts']} of {prediction['blows']}"))
    if metrics["stops"]:
        rows.append(("at stops", ", ".join(metrics["stops"])))
    page.pairs(rows)
    if len(document["runs"]) > 1:
        page.gap()
        parts = [
            (f"  {part['sign']:+d}", number(part["metrics"]["q_total_impact"]), number(part["metrics"]["peak_jump"]),
             number(part["waited"]))
            for part in document["runs"]
        ]  # fmt: skip
        page.table(("  push", "q_total_impact", "peak jump", "pushed after s"), parts, right=(1, 2, 3))
    page.gap()
    notes = [document["offline"]["note"]] if document["offline"] and document["offline"]["note"] else []
    if not metrics["rested"]:
        notes.append("the robot was not at rest before the push: its own motion is in what is measured")
    page.warnings(notes)
    page.line(f"written: {folder}")
