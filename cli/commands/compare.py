"""``impact-posture compare SCENARIO --controllers A,B``."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from impact_posture.config.problem_settings import JOBS
from impact_posture_cli import options
from impact_posture_cli.experiments import RUN, Compile, Processes, ScenarioName, Seeds, rows_table
from impact_posture_cli.output import Page, print_json

Controllers = Annotated[
    str,
    options.option(
        "--controllers", RUN, "Names as in simulate; append :held for --mode held, or :free for --free.",
        metavar="A,B,…",
    ),
]  # fmt: skip
Out = Annotated[str | None, options.out_option("Folder for comparison.json and figures.", "none")]


def compare(
    scenario: ScenarioName,
    controllers: Controllers = "nominal,robust,posture",
    seeds: Seeds = 3,
    jobs: Processes = JOBS,
    compile: Compile = "auto",
    out: Out = None,
    force: options.Force = False,
    format: options.Formats = None,
    no_report: options.NoReport = False,
    meshes: options.Meshes = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    labels = [text.strip() for text in controllers.split(",") if text.strip()]
    if not labels:
        raise typer.BadParameter("name at least one controller", param_hint="--controllers")
    from impact_posture.experiment.experiment_folders import Output, store_beside, write_comparison
    from impact_posture.experiment.jobs import controller_factory
    from impact_posture.experiment.reproduction import reproduce
    from impact_posture.experiment.seed_statistics import statistic
    from impact_posture.output.picture_formats import DEFAULT_FORMATS
    from impact_posture.system.output_folder import check_output

    plan = {scenario: list(dict.fromkeys(labels))}
    folder = None if out is None else Path(out)
    if folder is not None:
        check_output(folder, force=force, kind="comparison")
    page, failure = Page(json=json, quiet=quiet), ""
    with page.progress("preparing"):
        warnings = controller_factory(scenario).setup.warnings
    page.warnings(warnings)
    beside = nullcontext() if folder is None else store_beside(folder)
    with beside as store:
        with page.progress("running", "runs") as advance:
            reproduction = reproduce(
                plan, seeds=seeds, processes=jobs, store=store, progress=advance, compile=compile
            )
            if folder is not None and store is not None:
                output = Output(folder, force, format or DEFAULT_FORMATS, not no_report, meshes)
                failure = write_comparison(output, reproduction, store)
        page.warnings([failure and f"there is no report.html: {failure}"])
        if json:
            print_json(reproduction.comparison())
            return
        rows = reproduction.rows
        page.title(rows[0].scenario, statistic(seeds, [metric for row in rows for metric in row.metrics.values()]))
        rows_table(page, rows)
        if folder is not None:
            page.gap()
            page.line(f"written: {folder}")
