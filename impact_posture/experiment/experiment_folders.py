"""Output folders of runs, comparisons and reproductions.  Each folder is written completely or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from impact_posture.experiment.job_store import JobStore
from impact_posture.experiment.jobs import Document, Job
from impact_posture.experiment.reproduction import PAPER, Reproduction
from impact_posture.experiment.reproduction_summary import summary
from impact_posture.experiment.run_reports import COMPARISON, SIMULATION, keep_runs, run_view, stored_run, try_report
from impact_posture.output.picture_formats import DEFAULT_FORMATS
from impact_posture.output.plot import Bar, bars_figure, figures_of_comparison, figures_of_run, save, save_all
from impact_posture.simulation.run import Run
from impact_posture.system.output_folder import whole_folder, write_json
from impact_posture.system.progress import tell

REPRODUCTION = "reproduction.json"


@dataclass(frozen=True)
class Output:
    """Output folder of an experiment, and options for the figures and the report in it.

    Attributes:
        force: If true, an earlier result in the folder may be replaced.
        formats: File formats of the figures.
        report: If true, ``report.html`` is written.
        meshes: If true, the report shows the meshes of the robot.
    """

    folder: Path
    force: bool = False
    formats: Sequence[str] = DEFAULT_FORMATS
    report: bool = True
    meshes: bool = False


def write_simulation(output: Output, job: Job, runs: Sequence[Run], document: Document) -> str:
    """Write ``run.json``, ``series.npz`` (``series-minus.npz`` for a push with sign -1), figures and ``report.html``.

    Return the reason why the report is missing.  The text is empty if the report was written or not requested.

    Raises:
        OutputError: The folder exists and ``force`` is false, it contains files that this command did not write, or
            it cannot be written.
    """
    with whole_folder(output.folder, force=output.force, kind="run") as folder:
        write_json(folder / SIMULATION, document)
        for run in runs:
            run.series.save(folder / f"series{'' if run.sign > 0 else '-minus'}.npz")
        draw_runs(job, runs, document, folder, output.formats)
        return try_report(folder, job.scenario, meshes=output.meshes) if output.report else ""


def write_comparison(output: Output, comparison: Reproduction, store: JobStore) -> str:
    """Write ``comparison.json``, figures, ``runs/`` and ``report.html``, and remove the store of finished runs.

    Figures, ``runs/`` and the report show the first seed.  The return value is the same as in
    :func:`write_simulation`.

    Raises:
        OutputError: The same errors as in :func:`write_simulation`.
    """
    with whole_folder(output.folder, force=output.force, kind="comparison") as folder:
        write_json(folder / COMPARISON, comparison.comparison())
        draw_side_by_side(comparison.shown, store, folder, output.formats)
        keep_runs(folder, comparison.shown, store)
        scenario = comparison.shown[0].scenario
        failure = try_report(folder, scenario, meshes=output.meshes) if output.report else ""
    store.remove()
    return failure


def write_reproduction(output: Output, reproduction: Reproduction, store: JobStore) -> Document:
    """Write ``SUMMARY.md``, ``runs/``, figures and ``reproduction.json``, and remove the store of finished runs.

    Return the content of ``reproduction.json``.

    Raises:
        OutputError: The same errors as in :func:`write_simulation`.
    """
    document = {**reproduction.to_dict(), "summary": summary(reproduction)}
    with whole_folder(output.folder, force=output.force, kind="reproduction") as folder:
        write_json(folder / REPRODUCTION, document)
        (folder / "SUMMARY.md").write_text(document["summary"], encoding="utf-8")
        (folder / "runs").mkdir()
        for job in reproduction.jobs:
            write_json(folder / "runs" / f"{job.name}.json", store.finished(job))
        draw_reproduction(reproduction, store, folder, output.formats)
    store.remove()
    return document


def store_beside(out: Path) -> AbstractContextManager[JobStore]:
    """Lock and yield the :class:`JobStore` with finished runs for the output folder ``out``.

    Raises:
        OutputError: The same errors as in :meth:`JobStore.locked`.
    """
    return JobStore(out.absolute().parent / f".{out.name}.runs").locked()


def draw_runs(job: Job, runs: Sequence[Run], document: Document, folder: Path, formats: Sequence[str]) -> None:
    """Draw the figures of the runs of a job.  Figures of a second run (sign -1 of a push) go to ``minus/``."""
    for run, part in zip(runs, document["runs"], strict=True):
        tell("drawing")
        subfolder = folder if run is runs[0] else folder / "minus"
        save_all(figures_of_run(run_view(job, part, run.series)), subfolder, formats)


def draw_side_by_side(jobs: Sequence[Job], store: JobStore, folder: Path, formats: Sequence[str]) -> None:
    """Draw figures that compare controllers in one scenario.  The figures show the first run of each job."""
    tell("drawing")
    views = []
    for job in jobs:
        if (stored := stored_run(job, store)) is not None:
            document, series = stored
            views.append(run_view(job, document["runs"][0], series))
    if views:
        save_all(figures_of_comparison(views), folder, formats)


def draw_reproduction(reproduction: Reproduction, store: JobStore, folder: Path, formats: Sequence[str]) -> None:
    """Draw the figure ``bars`` and, for each scenario, figures that compare nominal, robust and best controller."""
    bars = []
    for row in reproduction.rows:
        paper, total = PAPER.get(row.scenario), row.metrics.get("q_total_impact")
        mean, half = (np.nan, 0.0) if total is None else (total.mean, total.shown or 0.0)
        # The paper gives values only for the nominal and the robust controller.
        bars.append(Bar(row.scenario, row.controller, mean, half, getattr(paper, row.controller, None)))
    save(bars_figure(bars), folder, "bars", formats)
    for scenario in reproduction.scenarios:
        best = reproduction.best(scenario)
        shown = dict.fromkeys(("nominal", "robust", *(() if best is None else (best.controller,))))
        labels = {job.label: job for job in reproduction.shown if job.scenario == scenario}
        draw_side_by_side([labels[label] for label in shown if label in labels], store, folder / scenario, formats)
