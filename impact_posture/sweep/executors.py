"""Executors that solve shards: local processes, a Dask cluster, MPI ranks, and Slurm jobs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from impact_posture.errors import InputError
from impact_posture.system.optional_package import import_extra

# A Dask scheduler must answer within ``_LONGEST_SILENCE`` (s).  A client that disconnects tries for ``_LEAVING`` (s)
# to inform the scheduler.
_LONGEST_SILENCE, _LEAVING = 30, 5


class DaskWorkers(Executor):
    """Executor of a Dask cluster, which can check that the scheduler of the cluster answers."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._executor, self._address = client, client.get_executor(), address

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Submit one call as a task."""
        future: Future[Any] = self._executor.submit(function, *arguments, **named)
        return future

    def check(self) -> None:
        """Wait for an answer of the scheduler, because a scheduler that is stopped keeps its connections open.

        Raises:
            TimeoutError: The scheduler does not answer.
        """
        try:
            self._client.sync(self._client.scheduler.echo, data="", callback_timeout=_LONGEST_SILENCE)
        except TimeoutError:
            raise TimeoutError(f"{self._address} has not answered for {_LONGEST_SILENCE} s") from None


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """Yield the executor of the Dask cluster whose scheduler has this ``address``, such as ``tcp://host:8786``.

    Raises:
        InputError: The package ``distributed`` is not installed, or no scheduler answers at the address.
    """
    import_extra("distributed", "dask")
    from distributed import Client

    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        what, hint = f"no Dask scheduler answers ({error})", "start a scheduler, or correct the address"
        raise InputError(what, where=f"scheduler {address}", hint=hint) from None
    with _unlogged("distributed", "distributed.client"):
        try:
            yield DaskWorkers(client, address)
        finally:
            with suppress(TimeoutError):
                client.close(timeout=_LEAVING)


@contextmanager
def _unlogged(*names: str) -> Iterator[None]:
    """Hide the log messages of other packages, because these packages also raise the errors in the messages."""
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def mpi_ranks() -> Iterator[Executor]:
    """Yield the executor that uses the MPI ranks of this program.

    Start the program with ``mpiexec -n N python -m mpi4py.futures $(which impact-posture) …``.

    Raises:
        InputError: The package ``mpi4py`` or an MPI library is not installed.
    """
    import_extra("mpi4py", "mpi")
    try:
        from mpi4py.futures import MPIPoolExecutor
    except (ImportError, RuntimeError) as error:
        raise InputError(f"MPI cannot be loaded ({error})", where="mpi", hint="install an MPI library") from None
    with MPIPoolExecutor() as pool:
        yield pool


class SlurmJobs(Executor):
    """Executor that submits each shard as an element of a Slurm job array, with the package submitit.

    Args:
        folder: Folder of the logs, which all nodes must be able to access.
        options: Parameters of ``submitit.AutoExecutor``, such as ``timeout_min`` or ``slurm_partition``.
        cluster: Cluster for submitit: ``slurm``, or ``local`` for processes of this machine; ``None`` to let submitit
            detect the cluster.
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
        self._waiting = ThreadPoolExecutor(1 << 10)

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
        return self._waiting.submit(self._jobs.submit(function, *arguments, **named).result)

    def submit_all(self, calls: Sequence[tuple[Any, ...]]) -> list[Future[Any]]:
        """Submit calls ``(function, *arguments)`` as one job array."""
        with self._jobs.batch():
            jobs = [self._jobs.submit(*call) for call in calls]
        return [self._waiting.submit(job.result) for job in jobs]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Stop the threads that wait for jobs (:meth:`concurrent.futures.Executor.shutdown`).  The jobs continue."""
        self._waiting.shutdown(wait=wait, cancel_futures=cancel_futures)


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
