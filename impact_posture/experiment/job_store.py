"""Many jobs in several processes.  Each is kept when it is done, so that an interrupted batch can go on."""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import io
import json
import os
import re
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from impact_posture.collision.coal_geometry import geometry_key
from impact_posture.collision.urdf_shapes import read_urdf_shapes
from impact_posture.config.cached_values import read_stored, write_stored
from impact_posture.errors import ImpactPostureError, InputError, MetricError, OutputError
from impact_posture.experiment.jobs import Document, Job, controller_factory, execute, lost, software
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_file import scenario_path
from impact_posture.system.libraries import source_key
from impact_posture.system.npz_files import MOST_BYTES
from impact_posture.system.output_folder import parents_of, write_whole
from impact_posture.system.processes import fork_map, undone
from impact_posture.system.scratch_folder import RECORD
from impact_posture.system.text_files import read_text

Progress = Callable[[int, int], None]
# Names of the files of a store, and of the parts of them that a killed process leaves.
_OURS = re.compile(r"\.?[0-9a-f]{64}(\.minus)?\.(json|npz)(\.\d+\.part)?")


class Store:
    """A folder of finished jobs.

    The name of a file is a hash of everything that the result of its job depends on (:func:`key_of`), so nothing is
    taken for the result of another job.  A document begins with a seal, which only this user can make.

    Args:
        folder: The folder, which is made when it is first written to.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._secret = _secret()

    @contextmanager
    def taken(self) -> Iterator[Store]:
        """Make the folder, and keep other commands out of it.  An empty one disappears at the end.

        Raises:
            OutputError: It cannot be made or written, is not ours, or another command works in it.
        """
        with parents_of(self.folder):
            lock = self._lock()
            try:
                with undone(self._remove_empty):
                    yield self
            finally:
                os.close(lock)

    def _lock(self) -> int:
        """Return a descriptor of the folder, which keeps others out while it is open."""
        with self._writing():
            try:
                self.folder.mkdir()
            except FileExistsError:
                if fault := self._fault():
                    hint = "runs are kept there until `out` is written: move it away, or choose another `out`"
                    raise OutputError(fault, where=str(self.folder), hint=hint) from None
            lock = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            what, hint = "another command keeps its runs there", "wait for its end, or choose another `out`"
            raise OutputError(what, where=str(self.folder), hint=hint) from None
        except OSError:
            # The file system has no locks.
            pass
        return lock

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            words = f"cannot be written ({error.strerror or error})"
            raise OutputError(words, where=str(self.folder), hint="free space or choose another `out`") from error

    def _fault(self) -> str:
        """Return why an existing folder cannot be used; empty if it can."""
        if self.folder.is_symlink() or not self.folder.is_dir():
            return "is no folder"
        if os.path.lexists(self.folder / RECORD):
            return "holds results of another command or version"
        return "" if os.access(self.folder, os.R_OK | os.W_OK | os.X_OK) else "cannot be written"

    def _remove_empty(self) -> None:
        with suppress(OSError):
            self.folder.rmdir()

    def remove(self) -> None:
        """Remove the files of jobs, and the folder unless it holds others."""
        with suppress(OSError):
            for entry in os.scandir(self.folder):
                if _OURS.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                    os.unlink(entry.path)
        self._remove_empty()

    def find(self, job: Job) -> Document | None:
        """Return the document of a finished job; ``None`` for no file, or one that is damaged or lacks its series."""
        path = self._path(job)
        try:
            seal, _, text = read_text(path).partition("\n") if path.is_file() else ("", "", "")
            if not hmac.compare_digest(seal.encode(), self._seal(job, text).encode()):
                return None
            kept = json.loads(text)
            if all(_digest(self.series(job, int(sign))) == digest for sign, digest in kept["series"].items()):
                document: Document = kept["document"]
                return document
        except (OSError, UnicodeError):
            pass
        return None

    def finished(self, job: Job) -> Document:
        """Return the document of a job that :func:`run_batch` has finished.

        Raises:
            OutputError: Somebody removed or changed it since.
        """
        document = self.find(job)
        if document is None:
            what = f"the run of {job.label} with seed {job.seed} is gone or was changed"
            raise OutputError(what, where=str(self.folder), hint="run the command again")
        return document

    def series(self, job: Job, sign: int) -> Path:
        """Return the path of the time series of a run."""
        return self._path(job).with_suffix(f"{'' if sign > 0 else '.minus'}.npz")

    def keep(self, job: Job, document: Document, runs: Sequence[Run] = ()) -> None:
        """Write a document and the time series of runs, so that :meth:`find` finds all or nothing.

        Raises:
            OutputError: They cannot be written.
        """
        with self._writing():
            self.folder.mkdir(parents=True, exist_ok=True)
        series = {}
        for one in runs:
            content = io.BytesIO()
            one.series.save(content)
            write_whole(self.series(job, one.sign), content.getvalue())
            series[str(one.sign)] = hashlib.sha256(content.getvalue()).hexdigest()
        text = json.dumps({"series": series, "document": document})
        write_whole(self._path(job), f"{self._seal(job, text)}\n{text}")

    def _path(self, job: Job) -> Path:
        return self.folder / f"{key_of(job)}.json"

    def _seal(self, job: Job, text: str) -> str:
        """Return the first line of a stored document, which only this text of this job has."""
        return hmac.digest(self._secret.encode(), f"{key_of(job)}\0{text}".encode(), "sha256").hex()


@dataclass(frozen=True)
class _Secret:
    text: str


def _secret() -> str:
    """Return a text that only this user knows; empty where the cache cannot be used, as a seal then shows damage."""
    found = read_stored("secret", "runs", _Secret)
    if found is None:
        write_stored("secret", "runs", _Secret(secrets.token_hex(32)))
        # Another process may have been faster.
        found = read_stored("secret", "runs", _Secret)
    return "" if found is None else found.text


def _digest(path: Path) -> str:
    """Return the hash of a time series; empty for what cannot be one."""
    if not path.is_file() or path.stat().st_size > MOST_BYTES:
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def key_of(job: Job) -> str:
    """Return a hash of everything that the result of a job depends on."""
    content = [source_key((), ""), repr(software()), repr(asdict(job)), _scenario(job.scenario)]
    return hashlib.sha256("\0".join(content).encode()).hexdigest()


@cache
def _scenario(scenario: str) -> str:
    """Return the text of the file, and what the other files of its experiment say."""
    setup = controller_factory(scenario, False).setup
    shapes = ""
    # A mesh that cannot be read shapes nothing.
    with suppress(OSError):
        shapes = geometry_key(setup.robot, read_urdf_shapes(setup.robot)[0])
    text = scenario_path(scenario).read_text(encoding="utf-8")
    return "\0".join((text, setup.robot.data_sha256, repr(setup.q.tolist()), shapes))


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
            if found is not None:
                done[k] = found
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
    return [done[k] for k in range(len(jobs))]


def _run(job: Job, store: Store | None) -> Document:
    runs: Sequence[Run] = ()
    try:
        runs, document = execute(job)
    except ImpactPostureError as error:
        if isinstance(error, InputError) and not isinstance(error, MetricError):
            # A mistake of the user is the same for all seeds, and no result.
            raise
        document = lost(job, error)
    if store is not None:
        store.keep(job, document, runs if job.shown else ())
    return document
