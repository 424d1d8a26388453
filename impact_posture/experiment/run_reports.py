"""Write reports of runs and comparisons from the files in their folders."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError, InputError, SpecError, one_line, shown
from impact_posture.experiment.job_store import JobStore
from impact_posture.experiment.jobs import SCHEMA as SIMULATION_SCHEMA
from impact_posture.experiment.jobs import Document, Job, controller_factory
from impact_posture.experiment.reproduction import COMPARISON_SCHEMA
from impact_posture.experiment.run_report_content import COARSE, FINE, comparison_content, run_content
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.output.plot.run_view import RunView
from impact_posture.output.report.drawn_robot import draw_robot
from impact_posture.output.report.report_page import write_page
from impact_posture.output.report.report_scene import ReportScene, Track, impact_curves
from impact_posture.simulation.scenario_file import known_scenarios, scenario_path
from impact_posture.simulation.series import Series, Window
from impact_posture.system.escape import file_name
from impact_posture.system.output_folder import write_json
from impact_posture.system.text_files import read_text

SIMULATION, COMPARISON, RUNS = "run.json", "comparison.json", "runs"
# The state has diverged if a position exceeds this value, m or rad.
_AWAY = 1e3
# Columns of :class:`Series` that figures use.
_COLUMNS = {field.name for field in fields(RunView)} & {field.name for field in fields(Series)}
_BROKEN = (LookupError, ArithmeticError, ValueError, TypeError, AttributeError, OSError, RecursionError)


def keep_runs(folder: Path, jobs: Sequence[Job], store: JobStore) -> None:
    """Write the document and the thinned time series of each job into ``runs/`` in the folder of a comparison.

    A run is left out if its state diverges within two ticks.
    """
    (folder / RUNS).mkdir()
    for job in jobs:
        if (stored := stored_run(job, store)) is not None:
            (document, series), path = stored, folder / RUNS / _stem(job.label)
            part = document["runs"][0]
            with suppress(InputError):
                thin(series, _windows(part)).save(_series(path, part["sign"]))
                write_json(path.with_name(f"{path.name}.json"), document)


def stored_run(job: Job, store: JobStore) -> tuple[Document, Series] | None:
    """Return the document of a stored job and the time series of its first run; ``None`` if the job has no runs."""
    document = store.finished(job)
    if not document["runs"]:
        return None
    return document, Series.load(store.series(job, document["runs"][0]["sign"]))


def run_view(job: Job, part: Document, series: Series) -> RunView:
    """Return the data of a run for figures.  If the run did not complete, the label contains its status."""
    factory = controller_factory(job.scenario, job.free, job.seed)
    setup, scenario, objective = factory.setup, factory.setup.scenario, factory.objective()
    return RunView(
        scenario=scenario.name,
        controller=job.controller,
        robot=setup.robot,
        contact=objective.contact,
        **{name: getattr(series, name) for name in _COLUMNS},
        windows=_windows(part),
        surface=np.array(setup.world.built.points[scenario.surface.name]) if scenario.contacts else None,
        supports=objective.supports,
        label=job.label if part["status"] == "completed" else f"{job.label} ({part['status']})",
        facts=(f"seed {job.seed}", *(() if scenario.contacts else (f"push {part['sign']:+d}",))),
    )


def try_report(folder: Path, scenario: str, *, meshes: bool) -> str:
    """Write the report of a folder; return the reason if that fails, because an exception would discard the runs."""
    try:
        write_run_report(folder, scenario, meshes=meshes, force=None)
    except Exception as error:
        return one_line(str(error) if isinstance(error, ImpactPostureError) else f"{type(error).__name__}: {error}")
    return ""


def write_run_report(folder: Path, scenario: str = "", *, meshes: bool = False, force: bool | None = False) -> Path:
    """Write ``report.html`` of a run or comparison into its folder.  Return the path of the report.

    Args:
        folder: Folder that ``simulate`` or ``compare`` has written.
        scenario: Name or file of the scenario; by default, the scenario that the folder names.
        meshes: If true, the report contains the meshes of the user's URDF.
        force: Whether a ``report.html`` of the user may be replaced; ``None`` in a new folder.

    Raises:
        SpecError: The folder contains neither a run nor a comparison, or its files are inconsistent.
        ImpactPostureError: The scenario cannot be set up.
        OutputError: A ``report.html`` of the user would be replaced, or the report cannot be written.
    """
    try:
        if os.path.isfile(folder / SIMULATION):
            document = _read(folder / SIMULATION, SIMULATION_SCHEMA)
            runs = _runs(document, folder / "series", scenario, len(document["runs"]))
            content = run_content(folder, document, runs[0][0], _job(document, scenario))
        else:
            document, runs = _read(folder / COMPARISON, COMPARISON_SCHEMA), []
            # Two controllers share a file if their names lead to the same file name.
            for stem in dict.fromkeys(_stem(row["controller"]) for row in document["rows"]):
                if (path := folder / RUNS / f"{stem}.json").is_file():
                    runs += _runs(_read(path, SIMULATION_SCHEMA), folder / RUNS / stem, scenario, 1)
            if not runs:
                raise SpecError(
                    "contains no run that can be shown", where=str(folder), hint="see the status in comparison.json"
                )
            content = comparison_content(folder, document, runs[0][0])
        return write_page(folder, content, run_scene(runs, meshes=meshes), force)
    except _BROKEN as error:
        what = f"contains no complete run or comparison ({type(error).__name__}: {error})"
        raise SpecError(what, where=str(folder), hint="run simulate or compare again") from None


def thin(series: Series, windows: Iterable[Window]) -> Series:
    """Return the time series of a run with fewer ticks, for the report.

    The ticks are denser within impact windows, and end when the state diverges.  Force and peak force at a kept tick
    are the largest values since the previous kept tick.

    Raises:
        InputError: The state diverges within two ticks.
    """
    away = np.flatnonzero(~(np.abs(series.q).max(axis=1) < _AWAY))
    t = series.t[: away[0]] if len(away) else series.t
    if len(t) < 2:
        raise InputError("the state diverges within two ticks", where="report", hint="the run has no report")
    step = float(t[1] - t[0])
    inside = np.zeros(len(t), dtype=bool)
    for window in windows:
        if window.kind == "impact":
            inside |= (t >= window.begin - FINE) & (t <= window.end)
    # Count ticks instead of comparing times, because sums of time steps have rounding errors.
    stride = np.where(inside, max(round(FINE / step), 1), max(round(COARSE / step), 1))
    kept = np.flatnonzero((np.arange(len(t)) % stride == 0) | (np.arange(len(t)) == len(t) - 1))
    size = np.linalg.norm(series.force[: len(t)], axis=1)
    begins = np.concatenate([[0], kept[:-1] + 1])
    strongest = [a + int(np.argmax(size[a : b + 1])) for a, b in zip(begins, kept, strict=True)]
    peaks = np.array([series.peak[a : b + 1].max() for a, b in zip(begins, kept, strict=True)])
    columns = {name: column[kept] for name, column in vars(series).items()}
    return Series(**columns | {"force": series.force[strongest], "peak": peaks})


def run_scene(runs: Sequence[tuple[RunView, WorstCaseObjective]], *, meshes: bool = False) -> ReportScene:
    """Return the 3D scene of the report for ``runs`` of one scenario, after :func:`thin`."""
    first, objective = runs[0]
    planes = []
    if first.surface is not None:
        planes.append(("surface", first.surface, np.array(first.contact.normal)))
    if first.supports:
        numeric = Numeric(first.robot.model).at(first.q[0])
        feet = [numeric.placement(point_on(first.robot, s.frame, s.offset)).translation for s in first.supports]
        planes.append(("ground", min(feet, key=lambda foot: float(foot[2])), np.array([0.0, 0.0, 1.0])))
    tracks = tuple(_track(*run) for run in runs)
    return ReportScene(draw_robot(first.robot, meshes), objective, tracks, tuple(planes), (), False)


def _track(view: RunView, objective: WorstCaseObjective) -> Track:
    jumps = np.zeros_like(view.v)
    for window in view.impacts:
        within = (view.t >= window.begin) & (view.t <= window.end)
        if within.any():
            jumps[within] = view.v[within] - view.v[max(int(np.argmax(within)) - 1, 0)]
    quantities = [objective.oracle.quantities(q) for q in view.q]
    force = ("largest normal force", "N", view.peak)
    curves = (*impact_curves(quantities, objective.metric), force)
    return Track(view.name, view.t, "s", view.q, [quantities], jumps, curves, view.force)


def _read(path: Path, schema: str) -> Document:
    document: Document = json.loads(read_text(path))
    if document["schema"] != schema:
        what = f"schema '{shown(document['schema'])}'"
        raise SpecError(what, where=str(path), hint="run simulate or compare again")
    return document


def _stem(label: str) -> str:
    return file_name(label.replace(":", "-"))


def _windows(part: Document) -> tuple[Window, ...]:
    return tuple(Window(**window) for window in part["windows"])


def _series(stem: Path, sign: int) -> Path:
    return stem.with_name(f"{stem.name}{'' if sign > 0 else '-minus'}.npz")


def _job(document: Document, scenario: str) -> Job:
    """Return the job of a document.  ``Job.scenario`` is the name of a shipped scenario, or the path of a file."""
    name, source = str(document["scenario"]), str(document["source"])
    shipped = name in known_scenarios() and Path(source) == scenario_path(name)
    scenario = scenario or (name if shipped else source)
    return Job(scenario, *(document[key] for key in ("controller", "seed", "mode", "free", "gain")))


def _runs(document: Document, stem: Path, scenario: str, count: int) -> list[tuple[RunView, WorstCaseObjective]]:
    job, runs = _job(document, scenario), []
    factory = controller_factory(job.scenario, job.free, job.seed)
    if document["model_sha256"] != factory.setup.robot.model_sha256:
        raise SpecError("contains a run with another robot model", where=str(stem.parent), hint="run it again")
    for part in document["runs"][:count]:
        view = run_view(job, part, thin(Series.load(_series(stem, part["sign"])), _windows(part)))
        label = f"{view.label}, push {part['sign']:+d}" if count > 1 else view.label
        runs.append((replace(view, label=label), factory.objective()))
    return runs
