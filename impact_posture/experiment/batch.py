"""Many jobs in several processes.  Each is kept when it is done, so that an interrupted batch can go on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path

from impact_posture.errors import ImpactPostureError, InputError, MetricError, OutputError, SpecError
from impact_posture.experiment.jobs import Document, Job, controller_factory, execute, lost
from impact_posture.libraries import source_key
from impact_posture.output_folder import is_ours, write_record, write_whole
from impact_posture.posture.ipopt import one_blas_thread
from impact_posture.processes import fork_map
from impact_posture.simulation.controller_factory import CONTROLLERS
from impact_posture.simulation.scenario_file import scenario_path
from impact_posture.simulation.series import Series
from impact_posture.version import __version__

Progress = Callable[[int, int], None]
_PARTS = (
    "robot",
    "dynamics",
    "collision",
    "impact",
    "posture",
    "path",
    "codegen",
    "tsid",
    "controller_export",
    "simulation",
    "experiment",
)


class Store:
    """A folder of finished jobs.

    A stored job only counts for the same scenario, robot and source code, and for the same :attr:`Job.compile`.  Runs
    in Python and in C lie side by side.

    Args:
        folder: The folder, which is made when it is first written to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self) -> None:
        """Make the folder if it does not exist.

        Raises:
            OutputError: It cannot be made.
        """
        try:
            with suppress(FileExistsError):
                self.folder.mkdir(parents=True)
                write_record(self.folder, "runs")
        except OSError as error:
            words = f"cannot be written ({error.strerror or error})"
            raise OutputError(words, where=str(self.folder), hint="free space or choose another `out`") from error

    def remove(self) -> None:
        """Remove the folder, if :meth:`make` made it.  Files of other types stay, and the folder with them."""
        if is_ours(self.folder, "runs"):
            with suppress(OSError):
                for path in self.folder.iterdir():
                    # A process that was killed leaves the part of a file.
                    if path.suffix in (".json", ".npz", ".part"):
                        path.unlink()
                self.folder.rmdir()

    def find(self, job: Job) -> Document | None:
        """Return the document of a finished job, or ``None`` for no file, a damaged file, or that of another job."""
        try:
            seal, _, text = self._path(job).read_text(encoding="utf-8").partition("\n")
        except (OSError, UnicodeDecodeError):
            return None
        if seal != _seal(job, text):
            return None
        document: Document = json.loads(text)
        return document

    def series(self, job: Job, sign: int) -> Path:
        """Return the path of the time series of a run."""
        return self._path(job).with_suffix(f"{'' if sign > 0 else '.minus'}.npz")

    def has_series(self, job: Job, document: Document) -> bool:
        """Whether all time series of a job are there and undamaged."""
        try:
            for part in document["runs"]:
                Series.load(self.series(job, part["sign"]))
        except SpecError:
            return False
        return True

    def keep(self, job: Job, document: Document) -> None:
        """Write a document, completely or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        self.make()
        text = json.dumps(document)
        write_whole(self._path(job), f"{_seal(job, text)}\n{text}")

    def _path(self, job: Job) -> Path:
        return self.folder / f"{job.name}-{job.compile}.json"


def _seal(job: Job, text: str) -> str:
    """Return the first line of a stored document, which only this text of this job has."""
    return hashlib.sha256(f"{key_of(job)}\0{text}".encode()).hexdigest()


def key_of(job: Job) -> str:
    """Return a hash of everything that the result of a job depends on."""
    content = [__version__, _source(), repr(asdict(job)), _scenario(job.scenario)]
    return hashlib.sha256("\0".join(content).encode()).hexdigest()


@cache
def _source() -> str:
    return source_key((), *_PARTS)


@cache
def _scenario(scenario: str) -> str:
    """Return the text of the file, and what its robot's files say."""
    robot = controller_factory(scenario, False).setup.robot.data_sha256
    return f"{scenario_path(scenario).read_text(encoding='utf-8')}\0{robot}"


def run_batch(
    jobs: Sequence[Job],
    *,
    processes: int = 1,
    store: Store | None = None,
    progress: Progress | None = None,
) -> list[Document]:
    """Run the jobs that are not stored yet, and return all documents in the order of the jobs.

    A job that fails on its own (a metric does not exist where the robot went) has a document without runs, with the
    status ``control lost``.

    Args:
        jobs: The jobs.
        processes: Number of processes.
        store: Folder where finished jobs are kept and found, with the time series of those that are shown.
        progress: Callback with (done, all).

    Raises:
        ImpactPostureError: A scenario cannot be set up, or there is no such controller.
    """
    done: dict[int, Document] = {}
    for k, job in enumerate(jobs):
        # Every wrong scenario or controller is refused here, before hours of runs.
        factory = controller_factory(job.scenario, job.free)
        if job.controller not in CONTROLLERS:
            # The key of a stored job does not cover the code of another package, so the job runs again.
            factory.driver(job.controller)
        elif store is not None:
            found = store.find(job)
            if found is not None and (not job.shown or store.has_series(job, found)):
                done[k] = found
    waiting = [k for k in range(len(jobs)) if k not in done]
    if progress:
        progress(len(done), len(jobs))

    def work(index: int) -> Document:
        job = jobs[waiting[index]]
        return _run(job, store if job.shown else None)

    with one_blas_thread(), fork_map(work, len(waiting), processes) as results:
        for index, document in results:
            k = waiting[index]
            done[k] = document
            if store is not None:
                store.keep(jobs[k], document)
            if progress:
                progress(len(done), len(jobs))
    return [done[k] for k in range(len(jobs))]


def _run(job: Job, store: Store | None) -> Document:
    try:
        runs, document = execute(job)
    except ImpactPostureError as error:
        if isinstance(error, InputError) and not isinstance(error, MetricError):
            # A mistake of the user is the same for all seeds, and no result.
            raise
        return lost(job, error)
    if store is not None:
        store.make()
        for one in runs:
            one.series.save(store.series(job, one.sign))
    return document
