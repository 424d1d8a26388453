"""Executors that solve shards on a Dask cluster or on MPI ranks."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from typing import Any

from impact_posture.errors import InputError
from impact_posture.system.optional_package import import_extra

# A Dask scheduler must answer within ``_LONGEST_SILENCE`` (s).  A cluster that lost all workers must get a worker
# within ``_WITHOUT_WORKERS`` (s).  A client that disconnects tries for ``_LEAVING`` (s) to inform the scheduler.
_LONGEST_SILENCE, _WITHOUT_WORKERS, _LEAVING = 30, 300, 5


class DaskWorkers(Executor):
    """Executor of a Dask cluster, which can check that the cluster answers and has workers."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._executor, self._address = client, client.get_executor(), address
        # Time at which the cluster last had workers, s.  A new cluster may wait for its first worker.
        self._last_workers = math.inf

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Submit one call as a task."""
        future: Future[Any] = self._executor.submit(function, *arguments, **named)
        future.add_done_callback(self._saw_workers)
        return future

    def _saw_workers(self, _: object = None) -> None:
        self._last_workers = time.monotonic()

    def check(self) -> None:
        """Ask the scheduler for its workers, because connections stay open even if the scheduler hangs.

        Raises:
            TimeoutError: The scheduler does not answer, or its workers are lost.
        """
        scheduler = self._client.scheduler
        try:
            workers = self._client.sync(scheduler.ncores, workers=None, callback_timeout=_LONGEST_SILENCE)
        except OSError:
            raise TimeoutError(f"{self._address} does not answer") from None
        if workers:
            self._saw_workers()
        elif time.monotonic() - self._last_workers > _WITHOUT_WORKERS:
            raise TimeoutError(f"{self._address} has had no workers for {_WITHOUT_WORKERS} s")


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
    with _unlogged("distributed", "distributed.client", "tornado.application", "asyncio"):
        try:
            yield DaskWorkers(client, address)
        finally:
            with suppress(TimeoutError):
                client.close(timeout=_LEAVING)


@contextmanager
def _unlogged(*names: str) -> Iterator[None]:
    """Hide the log messages of the packages ``names``, because they also raise the logged errors."""
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
