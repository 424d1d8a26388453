"""Output folders of runs, comparisons and reproductions.  Each is written completely or not at all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from impact_posture.experiment.batch import Store
from impact_posture.experiment.figures import draw_reproduction, draw_runs, draw_side_by_side
from impact_posture.experiment.jobs import Job
from impact_posture.experiment.reproduction import Plan, Reproduction, jobs_of
from impact_posture.experiment.reproduction_summary import summary
from impact_posture.experiment.run_reports import COMPARISON, SIMULATION, keep_runs, try_report
from impact_posture.output_folder import whole_folder
from impact_posture.simulation.run import Run

REPRODUCTION = "reproduction.json"
FORMATS = ("png",)


def write_simulation(
    out: Path,
    job: Job,
    runs: Sequence[Run],
    document: dict[str, Any],
    *,
    force: bool = False,
    formats: Sequence[str] = FORMATS,
    report: bool = True,
    meshes: bool = False,
) -> str:
    """Write ``run.json``, ``series.npz`` (``series-minus.npz`` for a push with sign -1), figures and ``report.html``.

    Returns:
        Why there is no report; empty if there is one, or if none was wanted.

    Raises:
        OutputError: The folder exists without ``force``, is not ours, or cannot be written.
    """
    with whole_folder(out, force=force, kind="run") as folder:
        _write_json(folder / SIMULATION, document)
        for one in runs:
            one.series.save(folder / f"series{'' if one.sign > 0 else '-minus'}.npz")
        draw_runs(job, runs, document, folder, formats)
        return try_report(folder, job.scenario, meshes=meshes) if report else ""


def write_comparison(
    out: Path,
    found: Reproduction,
    plan: Plan,
    store: Store,
    *,
    force: bool = False,
    formats: Sequence[str] = FORMATS,
    report: bool = True,
    meshes: bool = False,
) -> str:
    """Write ``comparison.json``, figures, ``runs/`` and ``report.html`` of the first seed, and remove the store.

    Returns:
        Why there is no report; empty if there is one, or if none was wanted.

    Raises:
        OutputError: As :func:`write_simulation`.
    """
    with whole_folder(out, force=force, kind="comparison") as folder:
        _write_json(folder / COMPARISON, found.comparison())
        jobs, failure = jobs_of(plan, seeds=1), ""
        draw_side_by_side(jobs, store, folder, formats)
        if report:
            keep_runs(folder, jobs, store)
            failure = try_report(folder, jobs[0].scenario, meshes=meshes)
    store.remove()
    return failure


def write_reproduction(
    out: Path, found: Reproduction, plan: Plan, store: Store, *, force: bool = False, formats: Sequence[str] = FORMATS
) -> dict[str, Any]:
    """Write ``reproduction.json``, ``SUMMARY.md``, all documents in ``runs/``, and figures, and remove the store.

    Returns:
        The content of ``reproduction.json``.

    Raises:
        OutputError: As :func:`write_simulation`.
    """
    document = {**found.to_dict(), "summary": summary(found)}
    with whole_folder(out, force=force, kind="reproduction") as folder:
        _write_json(folder / REPRODUCTION, document)
        (folder / "SUMMARY.md").write_text(document["summary"], encoding="utf-8")
        (folder / "runs").mkdir()
        for job in jobs_of(plan, found.seeds):
            _write_json(folder / "runs" / f"{job.name}.json", store.find(job))
        draw_reproduction(found, jobs_of(plan, seeds=1), store, folder, formats)
    store.remove()
    return document


def store_beside(out: Path) -> Store:
    """Return the store that keeps the runs of an output folder until it is written."""
    return Store(out.absolute().parent / f".{out.name}.runs")


def _write_json(path: Path, document: object) -> None:
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
