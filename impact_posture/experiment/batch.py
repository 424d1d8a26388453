"""Many jobs on several processes, each kept when it is done, so that what was interrupted goes on."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from impact_posture.errors import ImpactPostureError, InputError, MetricError, OutputError, SpecError
from impact_posture.experiment.jobs import SCHEMA, Job, controller_factory, execute
from impact_posture.output_folder import is_ours, write_record
from impact_posture.posture.compiled import own_source
from impact_posture.posture.nlp import one_blas_thread
from impact_posture.processes import fork_map
from impact_posture.simulation.controller_factory import CONTROLLERS
from impact_posture.simulation.scenario_file import scenario_path
from impact_posture.simulation.series import Series
from impact_posture.version import __version__

Document = dict[str, Any]
Progress = Callable[[int, int], None]
_PARTS = ("robot", "dynamics", "impact", "posture", "codegen", "tsid", "simulation", "experiment")


class Store:
    """A folder of finished jobs.

    What it holds counts only for the very scenario, robot and program that it was made by.

    Args:
        folder: Made when first written to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self) -> None:
        """Make the folder where there is none."""
        with suppress(FileExistsError):
            self.folder.mkdir(parents=True)
            write_record(self.folder, "runs")

    def remove(self) -> None:
        """Remove the folder, if it was made by :meth:`make`."""
        if is_ours(self.folder, "runs"):
            shutil.rmtree(self.folder, ignore_errors=True)

    def find(self, job: Job) -> Document | None:
        """The document of a job that is done; a file that is not whole, or another's, is none."""
        try:
            seal, _, text = self._path(job).read_text(encoding="utf-8").partition("\n")
        except (OSError, UnicodeDecodeError):
            return None
        if seal != _seal(job, text):
            return None
        document: Document = json.loads(text)
        return document

    def series(self, job: Job, sign: int) -> Path:
        """Where the time series of a run is kept."""
        return self.folder / f"{job.name}{'' if sign > 0 else '-minus'}.npz"

    def keep(self, job: Job, document: Document) -> None:
        """Keep a document, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        path = self._path(job)
        beside = path.with_suffix(f".{os.getpid()}.part")
        try:
            self.make()
            text = json.dumps(document)
            beside.write_text(f"{_seal(job, text)}\n{text}", encoding="utf-8")
            os.replace(beside, path)
        except OSError as error:
            words = error.strerror or str(error)
            raise OutputError(
                f"cannot be written ({words})", where=str(path), hint="free space or choose another --out"
            ) from error

    def _path(self, job: Job) -> Path:
        return self.folder / f"{job.name}.json"


def _seal(job: Job, text: str) -> str:
    """What a kept document begins with: no other text, and no other job, has it."""
    return hashlib.sha256(f"{key_of(job)}\0{text}".encode()).hexdigest()


def key_of(job: Job) -> str:
    """Hash of everything that a job's result depends on."""
    content = [__version__, _program(), repr(asdict(job)), _scenario(job.scenario)]
    return hashlib.sha256("\0".join(content).encode()).hexdigest()


@cache
def _program() -> str:
    return own_source(*_PARTS)


@cache
def _scenario(scenario: str) -> str:
    """The file, and the robot that it leads to."""
    model = controller_factory(scenario).setup.robot.model_sha256
    return f"{scenario_path(scenario).read_text(encoding='utf-8')}\0{model}"


def run_batch(
    jobs: Sequence[Job],
    *,
    processes: int = 1,
    store: Store | None = None,
    keep_series: Callable[[Job], bool] = lambda job: False,
    progress: Progress | None = None,
) -> list[Document]:
    """Run jobs, those first that are not done yet; documents in the jobs' order.

    A job that fails on its own (a metric that does not exist where it went) has a document without runs, of the
    status ``control lost``.

    Args:
        jobs: What to run.
        processes: How many at once.
        store: Where finished ones are kept and found.
        keep_series: Whose time series are kept beside; needs a store.
        progress: Told of (done, all).

    Raises:
        ImpactPostureError: A scenario that cannot be set up, or no such controller.
    """
    done: dict[int, Document] = {}
    for k, job in enumerate(jobs):
        if job.controller not in CONTROLLERS:
            # Refused here, before hours of other runs: the factory says what is wrong.
            controller_factory(job.scenario).driver(job.controller)
        found = None if store is None else store.find(job)
        if found is not None and (store is None or not keep_series(job) or _has_series(store, job, found)):
            done[k] = found
    waiting = [k for k in range(len(jobs)) if k not in done]
    if progress:
        progress(len(done), len(jobs))
    for job in jobs:
        # Everything that can be wrong with a scenario is said before the first run.
        controller_factory(job.scenario, job.free)

    def work(index: int) -> Document:
        job = jobs[waiting[index]]
        return _one(job, store if keep_series(job) else None)

    with one_blas_thread(), fork_map(work, len(waiting), processes) as results:
        for index, document in results:
            k = waiting[index]
            done[k] = document
            if store is not None:
                store.keep(jobs[k], document)
            if progress:
                progress(len(done), len(jobs))
    return [done[k] for k in range(len(jobs))]


def _one(job: Job, store: Store | None) -> Document:
    try:
        runs, document = execute(job)
    except ImpactPostureError as error:
        if isinstance(error, InputError) and not isinstance(error, MetricError):
            # The user's, and the same for all seeds: not a result.
            raise
        event = {"status": "control lost", "time": getattr(error, "time", None), "what": str(error), "sign": None}
        return {"schema": SCHEMA, "scenario": job.scenario, "controller": job.controller, "mode": job.mode,
                "free": job.free, "seed": job.seed, "status": "control lost", "events": [event], "metrics": None,
                "prediction": None, "windows": [], "runs": []}  # fmt: skip
    if store is not None:
        store.make()
        for one in runs:
            one.series.save(store.series(job, one.sign))
    return document


def _has_series(store: Store, job: Job, document: Document) -> bool:
    try:
        for part in document["runs"]:
            Series.load(store.series(job, part["sign"]))
    except SpecError:
        return False
    return True
