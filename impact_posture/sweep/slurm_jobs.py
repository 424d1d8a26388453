"""Executor that solves shards in Slurm jobs."""

from __future__ import annotations

import io
import os
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from contextlib import ExitStack, redirect_stderr, suppress
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from impact_posture.errors import InputError, WorkerDied
from impact_posture.system.optional_package import import_extra
from impact_posture.system.processes import undone

# Time between two searches for results, and between two queries of the job queue, s.
_RESULTS, _QUESTIONS = 1, 10
# Longest delay with which a file that another machine wrote appears after the end of its job, s.
_FILE_DELAY = 30
# Time limits for ``squeue``, and for ``scancel`` at the end, s.  A Slurm command itself gives up after 10 s without
# an answer.
_ANSWER, _LEAVING = 20, 5
# Longest time without an answer or a result, s.  If the Slurm controller fails, its backup takes over after 120 s.
_LONGEST_SILENCE = 180


class SlurmJobs(Executor):
    """Executor that submits each shard as an element of a Slurm job array, with the package submitit.

    The executor asks ``squeue`` for lost jobs, because ``sacct``, which submitit asks, fails on clusters without
    accounting.

    Args:
        folder: Folder of the logs, which all nodes must be able to access.
        options: Parameters of ``submitit.AutoExecutor``, such as ``timeout_min`` or ``slurm_partition``.
        cluster: Cluster for submitit: ``slurm``, or ``local`` for processes of this machine; ``None`` to let submitit
            detect the cluster.

    Raises:
        InputError: submitit is not installed, or it does not know one of the options.
    """

    def __init__(self, folder: Path, options: dict[str, Any], cluster: str | None = None) -> None:
        import_extra("submitit", "slurm")
        self._folder, self._options, self._cluster = folder, options, cluster
        # submitit creates the folder together with the executor.  Check the options in a temporary folder, so that
        # invalid options leave no folder.
        with TemporaryDirectory() as trial:
            try:
                self._executor(Path(trial))
            except (NameError, TypeError, ValueError, AssertionError) as error:
                raise InputError(str(error), where="slurm", hint="give parameters of submitit.AutoExecutor") from None
        # Jobs that have no result yet, and the times since which Slurm does not know them, s.
        self._open: dict[Future[Any], Any] = {}
        self._missing: dict[Future[Any], float] = {}
        self._closed = threading.Event()
        self._cleanup = ExitStack()
        self._cleanup.enter_context(undone(self._cancel))
        threading.Thread(target=self._watch, daemon=True).start()

    def _executor(self, folder: Path) -> Any:
        import submitit

        executor = submitit.AutoExecutor(folder, cluster=self._cluster)
        executor.update_parameters(**self._options)
        return executor

    @cached_property
    def _jobs(self) -> Any:
        return self._executor(self._folder)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Submit one call as a job."""
        return self.submit_all([(partial(function, **named), *arguments)])[0]

    def submit_all(self, calls: Sequence[tuple[Any, ...]]) -> list[Future[Any]]:
        """Submit calls ``(function, *arguments)`` as one job array.

        Raises:
            InputError: Slurm does not accept the jobs.
        """
        import submitit

        # submitit prints the error of sbatch, and raises it.
        with redirect_stderr(io.StringIO()):
            try:
                with self._jobs.batch():
                    jobs = [self._jobs.submit(_attempt, *call) for call in calls]
            except submitit.core.utils.FailedJobError as error:
                reason = str(error).strip().rpartition("\n")[2] or "no reason given"
                hint = "correct the options, or check the cluster with sinfo"
                raise InputError(f"the jobs cannot be submitted ({reason})", where="slurm", hint=hint) from None
        futures: list[Future[Any]] = [Future() for _ in jobs]
        self._open |= dict(zip(futures, jobs, strict=True))
        return futures

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel the jobs of Slurm that still wait or run, because their results are not read any more."""
        self._closed.set()
        self._cleanup.close()

    def _cancel(self) -> None:
        # Local jobs, which print an error if they are cancelled, end by themselves.
        if self._open and self._jobs.cluster == "slurm":
            _ask(_LEAVING, "scancel", *{job.job_id.partition("_")[0] for job in list(self._open.values())})

    def _watch(self) -> None:
        heard = question = time.monotonic()
        while not self._closed.wait(_RESULTS):
            now = time.monotonic()
            if self._collect() or not self._open:
                heard = now
            if now - question < _QUESTIONS:
                continue
            question = now
            if self._end_lost(now):
                heard = now
            elif now - heard > _LONGEST_SILENCE:
                for future in list(self._open):
                    what = f"the Slurm controller has not answered for {_LONGEST_SILENCE} s"
                    self._end(future, WorkerDied("slurm", what))

    def _collect(self) -> bool:
        """Pass on the results that jobs have written; return whether there is a new result."""
        with suppress(OSError):
            # A change of the mode makes NFS read the folder again.
            self._folder.chmod(self._folder.stat().st_mode)
        written = [item for item in list(self._open.items()) if os.path.exists(item[1].paths.result_pickle)]
        for future, job in written:
            self._end(future, _result(job, self._folder))
        return bool(written)

    def _end_lost(self, now: float) -> bool:
        """End the futures whose jobs ended without a result, and return whether Slurm answers."""
        jobs = dict(self._open)
        if self._jobs.cluster == "slurm":
            queue = _ask(_ANSWER, "squeue", "--me", "--noheader", "--array", "--format=%i") if jobs else []
        else:
            queue = [job.job_id for job in jobs.values() if not job.done()]
        if queue is None:
            return False
        self._missing = {f: self._missing.get(f, now) for f, job in jobs.items() if job.job_id not in set(queue)}
        for future, since in self._missing.items():
            if now - since > _FILE_DELAY:
                what = f"job {jobs[future].job_id} ended without a result; logs in {self._folder}"
                self._end(future, WorkerDied("slurm", what))
        return True

    def _end(self, future: Future[Any], result: Any) -> None:
        del self._open[future]
        if isinstance(result, Exception):
            future.set_exception(result)
        else:
            future.set_result(result)


def _attempt(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return the result or the error of a call.  submitit itself would return only the text of an error."""
    try:
        return function(*arguments)
    except Exception as error:
        return error


def _result(job: Any, folder: Path) -> Any:
    """Return the result or the error of a job that has written it."""
    try:
        return job.result()
    except Exception:
        return WorkerDied("slurm", f"job {job.job_id} failed; logs in {folder}")


def _ask(time_limit: float, *words: str) -> list[str] | None:
    """Run a command of Slurm, and return the words that it prints, or ``None`` if it fails."""
    # Variables such as SQUEUE_STATES change what the commands print.
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("SQUEUE_", "SCANCEL_"))}
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=time_limit, env=environment)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return None if done.returncode else done.stdout.split()


def parse_options(texts: Sequence[str]) -> dict[str, Any]:
    """Parse texts of the form ``KEY=VALUE``.  A value that consists of decimal digits becomes an integer.

    Raises:
        InputError: An option is not of the form ``KEY=VALUE``.
    """
    options: dict[str, Any] = {}
    for text in texts:
        key, _, value = text.partition("=")
        if not (key.isidentifier() and value):
            raise InputError(f"'{text}' is not KEY=VALUE", where="slurm", hint="give for example timeout_min=60")
        options[key] = int(value) if value.isdecimal() else value
    return options
