"""Store of finished jobs, with which an interrupted comparison can continue."""

from __future__ import annotations

import hashlib
import io
import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path

from impact_posture.collision.coal_geometry import geometry_key, read_shapes
from impact_posture.errors import ImpactPostureError, InputError, MetricError, OutputError
from impact_posture.experiment.jobs import Document, Job, controller_factory, execute, lost_control, software
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import scenario_path
from impact_posture.system.libraries import source_key
from impact_posture.system.output_folder import parents_of, used_alone, write_whole
from impact_posture.system.processes import fork_map, undone
from impact_posture.system.sealed_files import opened_text, sealed_text
from impact_posture.system.text_files import read_bytes, read_text

Progress = Callable[[int, int], None]
# Pattern of the names of stored files, and of incomplete files that a killed process leaves.
_STORED = re.compile(r"\.?[0-9a-f]{64}(\.minus)?\.(json|npz)(\.\d+\.part)?")
# Errors that occur if a document does not have the expected structure.
_BROKEN = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError)


class JobStore:
    """Folder with the documents and time series of finished jobs.

    The name of a file is a hash of the settings, robot files and software of its job (:func:`key_of`).  A document
    begins with its checksum and contains the checksums of its time series.  If a file is damaged, its job runs again.

    Attributes:
        used: Whether :func:`run_batch` has returned stored documents.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.used = folder, False

    @contextmanager
    def locked(self) -> Iterator[JobStore]:
        """Create the folder and lock it against other commands.  Remove the folder at the end if it is empty.

        Raises:
            OutputError: The folder cannot be created or read, another command uses the folder, or somebody changed a
                stored document together with its checksum.
        """
        with parents_of(self.folder):
            self._make_folder()
            with used_alone(self.folder, self.folder), undone(self._remove_empty):
                try:
                    yield self
                except _BROKEN as error:
                    if not self.used or isinstance(error, OSError):
                        raise
                    what = f"contains runs that cannot be used ({type(error).__name__}: {error})"
                    hint = "delete this folder, and report the error if it comes again"
                    raise OutputError(what, where=str(self.folder), hint=hint) from error

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            hint = "runs are stored there until `out` is written: remove the file, or choose another `out`"
            raise OutputError(f"cannot be created ({error.strerror})", where=str(self.folder), hint=hint) from error

    def _remove_empty(self) -> None:
        with suppress(OSError):
            self.folder.rmdir()

    def remove(self) -> None:
        """Remove the stored files, and the folder if it is empty afterwards."""
        with suppress(OSError):
            for path in self.folder.iterdir():
                if _STORED.fullmatch(path.name):
                    path.unlink()
        self._remove_empty()

    def find(self, job: Job) -> Document | None:
        """Return the document of a finished job, or ``None`` if a file is missing or damaged."""
        try:
            stored = json.loads(opened_text(read_text(self._path(job))))
            for sign, checksum in stored["series"].items():
                if checksum != _checksum(read_bytes(self.series(job, int(sign)))):
                    return None
            document: Document = stored["document"]
        except (OSError, *_BROKEN):
            return None
        return document

    def finished(self, job: Job) -> Document:
        """Return the document of a job that :func:`run_batch` has finished.

        Raises:
            OutputError: A stored file was removed or changed after the job finished.
        """
        document = self.find(job)
        if document is None:
            what = f"the run of {job.label} with seed {job.seed} was deleted or changed"
            raise OutputError(what, where=str(self.folder), hint="run the command again")
        return document

    def series(self, job: Job, sign: int) -> Path:
        """Return the path of the time series of the run of a job with the push sign ``sign``."""
        return self._path(job).with_suffix(f"{'' if sign > 0 else '.minus'}.npz")

    def keep(self, job: Job, document: Document, runs: Sequence[Run] = ()) -> None:
        """Write the document of a job and the time series of its runs.

        The document is written last, so :meth:`find` returns ``None`` after an interrupted call.

        Raises:
            OutputError: The files cannot be written.
        """
        self._make_folder()
        checksums = {}
        for run in runs:
            content = io.BytesIO()
            run.series.save(content)
            write_whole(self.series(job, run.sign), content.getvalue())
            checksums[str(run.sign)] = _checksum(content.getvalue())
        text = json.dumps({"series": checksums, "document": document})
        write_whole(self._path(job), sealed_text(text))

    def _path(self, job: Job) -> Path:
        return self.folder / f"{key_of(job)}.json"


def _checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def key_of(job: Job) -> str:
    """Return a hash of the settings, robot files and software on which the result of a job depends."""
    content = [source_key((), ""), repr(software()), repr(asdict(job)), _scenario(job.scenario)]
    return _checksum("\0".join(content).encode())


@cache
def _scenario(scenario: str) -> str:
    """Return the text of a scenario file, and hashes of the files that the scenario names."""
    setup = controller_factory(scenario, False).setup
    shapes = ""
    # A mesh that cannot be read has no effect on the results, so it is not part of the hash.
    with suppress(OSError):
        shapes = geometry_key(setup.robot, read_shapes(setup.robot)[0])
    text = read_text(scenario_path(scenario))
    return "\0".join((text, setup.robot.data_sha256, repr(setup.q.tolist()), shapes))


def run_batch(
    jobs: Sequence[Job], *, processes: int = 1, store: JobStore | None = None, progress: Progress | None = None
) -> list[Document]:
    """Run the jobs that are not stored yet, and return all documents in the order of the jobs.

    If a job fails, for example because a metric is undefined, its document has no runs and the status ``control
    lost``.  Time series are stored for jobs with :attr:`Job.shown`.  ``progress`` is called with the number of
    finished jobs and the number of all jobs.

    Raises:
        ImpactPostureError: A scenario cannot be set up, or a controller does not exist.
    """
    done: dict[int, Document] = {}
    for k, job in enumerate(jobs):
        # Set up every scenario and controller before the first run, so that mistakes appear at once.
        factory = controller_factory(job.scenario, job.free)
        if job.controller not in CONTROLLERS:
            # The controller belongs to another package.  The key of a job does not contain the code of other
            # packages, so the job always runs again.
            factory.driver(job.controller)
        elif store is not None:
            document = store.find(job)
            if document is not None:
                done[k] = document
    waiting = [k for k in range(len(jobs)) if k not in done]
    if progress:
        progress(len(done), len(jobs))

    def work(index: int) -> Document:
        return _run(jobs[waiting[index]], store)

    with one_blas_thread(), fork_map(work, len(waiting), processes) as results:
        for index, document in results:
            done[waiting[index]] = document
            if progress:
                progress(len(done), len(jobs))
    if store is not None:
        store.used |= len(waiting) < len(jobs)
    return [done[k] for k in range(len(jobs))]


def _run(job: Job, store: JobStore | None) -> Document:
    runs: Sequence[Run] = ()
    try:
        runs, document = execute(job)
    except ImpactPostureError as error:
        if isinstance(error, InputError) and not isinstance(error, MetricError):
            # A wrong input fails with every seed, so the error ends the batch.
            raise
        document = lost_control(job, error)
    if store is not None:
        store.keep(job, document, runs if job.shown else ())
    return document
