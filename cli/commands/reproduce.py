"""``impact-posture reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from impact_posture.config.problem_settings import JOBS
from impact_posture_cli import options
from impact_posture_cli.experiments import RUN, Compile, Processes, Seeds, rows_table
from impact_posture_cli.output import Page, print_json

All = Annotated[bool, options.option("--all", RUN, "Run every controller, not only the recommended ones.")]
Scenarios = Annotated[
    list[str] | None, options.option("--scenario", RUN, "One scenario; repeatable.", show_default="all four")
]
Out = Annotated[str, options.out_option("Folder of the results.")]


def reproduce(
    seeds: Seeds = 10,
    jobs: Processes = JOBS,
    compile: Compile = "auto",
    all_: All = False,
    scenario: Scenarios = None,
    out: Out = "reproduction",
    force: options.Force = False,
    format: options.Formats = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    from impact_posture.errors import ScenarioNotFound
    from impact_posture.experiment.experiment_folders import Output, store_beside, write_reproduction
    from impact_posture.experiment.reproduction import PAPER, controllers_of
    from impact_posture.experiment.reproduction import reproduce as reproduce_all
    from impact_posture.experiment.reproduction_summary import advice
    from impact_posture.output.picture_formats import DEFAULT_FORMATS
    from impact_posture.system.output_folder import check_output

    scenarios = list(dict.fromkeys(scenario)) if scenario else list(PAPER)
    for name in scenarios:
        if name not in PAPER:
            raise ScenarioNotFound(name, PAPER, hint="(others: simulate and compare)")
    folder = Path(out)
    check_output(folder, force=force, kind="reproduction")
    page = Page(json=json, quiet=quiet)
    with store_beside(folder) as store:
        with page.progress("running", "runs") as advance:
            plan = {name: controllers_of(name, all_) for name in scenarios}
            reproduction = reproduce_all(
                plan, seeds=seeds, processes=jobs, store=store, progress=advance, compile=compile
            )
            document = write_reproduction(Output(folder, force, format or DEFAULT_FORMATS), reproduction, store)
        if json:
            print_json(document)
            return
        for name in scenarios:
            paper = PAPER[name]
            page.title(name, f"the paper: {paper.nominal:g} to {paper.robust:g}, {100 * paper.reduction:.1f} % less")
            rows_table(page, reproduction.of(name))
            page.gap()
        for line in advice(reproduction):
            page.line(line.replace("**", "").replace("`", ""))
        page.gap()
        page.line(f"written: {folder}; read {folder / 'SUMMARY.md'}")
