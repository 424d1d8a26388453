"""Figures of runs, drawn by :mod:`impact_posture.plot`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from impact_posture.experiment.batch import Document, Store
from impact_posture.experiment.jobs import Job, controller_factory
from impact_posture.experiment.paper import PAPER
from impact_posture.experiment.reproduction import Reproduction
from impact_posture.plot import Bar, RunView, bars_figure, figures_of_comparison, figures_of_run, save, save_all
from impact_posture.progress import tell
from impact_posture.simulation.run import Run
from impact_posture.simulation.series import Series, Window

# Columns of the time series that figures show.
_COLUMNS = {field.name for field in fields(RunView)} & {field.name for field in fields(Series)}


def draw_runs(job: Job, runs: Sequence[Run], document: Document, folder: Path, formats: Sequence[str]) -> None:
    """Draw the figures of a job.  Those of the push with sign -1 are in ``minus/``."""
    for one, part in zip(runs, document["runs"], strict=True):
        into = folder if one is runs[0] else folder / "minus"
        tell("drawing")
        view = run_view(job, one.series, one.windows, one.sign, part["status"])
        save_all(figures_of_run(view), into, formats)


def draw_side_by_side(jobs: Sequence[Job], store: Store, folder: Path, formats: Sequence[str]) -> None:
    """Draw several controllers in one scenario, with the first sign of a push."""
    tell("drawing")
    views = [view for job in jobs if (view := _stored_view(job, store)) is not None]
    if views:
        save_all(figures_of_comparison(views), folder, formats)


def draw_reproduction(found: Reproduction, store: Store, folder: Path, formats: Sequence[str]) -> None:
    """Draw ``bars``, and for each scenario a folder with nominal, robust and the best controller side by side."""
    bars = []
    for row in found.rows:
        paper, total = PAPER.get(row.scenario), row.metrics.get("q_total_impact")
        mean, half = (np.nan, 0.0) if total is None else (total.mean, total.half_width or 0.0)
        # The paper has the nominal and the robust controller.
        bars.append(Bar(row.scenario, row.controller, mean, half, getattr(paper, row.controller, None)))
    save(bars_figure(bars), folder, "bars", formats)
    for scenario in found.scenarios:
        best = found.best(scenario)
        shown = dict.fromkeys(("nominal", "robust", *(() if best is None else (best.controller,))))
        labels = {job.label: job for job in found.shown if job.scenario == scenario}
        draw_side_by_side([labels[label] for label in shown if label in labels], store, folder / scenario, formats)


def run_view(job: Job, series: Series, windows: Sequence[Window], sign: int, status: str) -> RunView:
    """Return the view of a run, with a label that says if the run did not complete."""
    factory = controller_factory(job.scenario, job.free)
    setup, scenario, objective = factory.setup, factory.setup.scenario, factory.objective()
    return RunView(
        scenario=scenario.name,
        controller=job.controller,
        robot=setup.robot,
        contact=objective.contact,
        **{name: getattr(series, name) for name in _COLUMNS},
        windows=tuple(windows),
        surface=np.array(setup.world.built.points[scenario.surface.name]) if scenario.contacts else None,
        supports=objective.supports,
        label=job.label if status == "completed" else f"{job.label} ({status})",
        facts=(f"seed {job.seed}", *(() if scenario.contacts else (f"push {sign:+d}",))),
    )


def _stored_view(job: Job, store: Store) -> RunView | None:
    """Return the view of the first run of a stored job, or ``None`` if it has no runs."""
    document = store.find(job)
    if document is None or not document["runs"]:
        return None
    part = document["runs"][0]
    series = Series.load(store.series(job, part["sign"]))
    return run_view(job, series, [Window(**w) for w in part["windows"]], part["sign"], part["status"])
