"""Share work among forked processes, run a function in a copy of this process, and end a process early."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from multiprocessing.process import BaseProcess
from typing import Any, Generic, NoReturn, TypeVar, cast

from impact_posture.errors import WorkerDied

_Result = TypeVar("_Result")

# Signals by which a user or the system ends a process.  A closed terminal sends SIGHUP.
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# Forked workers read their function here, because a function with a CasADi solver cannot be sent to another process.
_WORK: dict[str, Callable[[int], Any]] = {}

# Functions to call when a process ends early.  Each entry has the id of the process that added it, because a fork
# inherits the list.
_UNFINISHED: list[tuple[int, Callable[[], None]]] = []

# Number of active :func:`signals_held` blocks, and the ``leave`` functions of signals that arrived in these blocks.
_HELD = [0]
_LATER: list[Callable[[], None]] = []

_PR_SET_PDEATHSIG = 1


@contextmanager
def undone(undo: Callable[[], None]) -> Iterator[None]:
    """Call ``undo`` at the end of the block, also if a signal ends the process (:func:`end_early`).

    It must be safe to call ``undo`` twice, because a signal may arrive while ``undo`` runs.
    """
    entry = (os.getpid(), undo)
    _UNFINISHED.append(entry)
    try:
        yield
    finally:
        undo()
        _UNFINISHED.remove(entry)


@contextmanager
def signals_held() -> Iterator[None]:
    """Delay the signals :data:`ENDING` until the end of the block."""
    # The signal mask holds for this thread, and for processes that are forked in the block.  The count in _HELD also
    # delays a signal that another thread of this process gets.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    _HELD[0] += 1
    try:
        yield
    finally:
        _HELD[0] -= 1
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if _LATER and not _HELD[0]:
            end_early(_LATER[0])


def end_early(leave: Callable[[], None]) -> None:
    """End the workers and copies, call the functions of :func:`undone`, newest first, then call ``leave``.

    A signal handler calls this function, and ``leave`` calls ``os._exit``.  An exception is not enough, because the
    wrappers of C++ libraries treat a ``KeyboardInterrupt`` as a failed conversion and continue.
    """
    if _HELD[0]:
        _LATER.append(leave)
        return
    _end(multiprocessing.active_children())
    for pid, undo in reversed(_UNFINISHED):
        if pid == os.getpid():
            with suppress(Exception):
                undo()
    leave()


def _end(children: Sequence[BaseProcess]) -> None:
    """Terminate processes.  Kill a process that still runs after one second."""
    for child in children:
        child.terminate()
    for child in children:
        child.join(1)
        child.kill()
        child.join(1)


def _worker(index: int) -> tuple[int, Any]:
    return index, _WORK["function"](index)


@contextmanager
def process_pool(workers: int) -> Iterator[Executor]:
    """Yield a pool of forked processes, which end at the end of the ``with`` block."""
    # Fork the workers.  Spawned workers would import all modules again, and would leave semaphores behind after a
    # signal.
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), depend, (os.getpid(),))
    others = set(multiprocessing.active_children())
    try:
        # The first submit forks all workers, before the pool starts a thread.  The workers inherit blocked signals,
        # because the terminal sends Ctrl-C to every process and only the main process should react.
        with signals_held():
            pool.submit(os.getpid)
        yield pool
    finally:
        for child in set(multiprocessing.active_children()) - others:
            child.kill()
        pool.shutdown(cancel_futures=True)


@contextmanager
def fork_map(function: Callable[[int], _Result], count: int, jobs: int) -> Iterator[Iterator[tuple[int, _Result]]]:
    """Yield ``(index, function(index))`` for each index below ``count``, in the order in which the calls finish.

    The calls run in forked processes if ``jobs`` is more than one and the system can fork.  Otherwise, the calls run
    in this process, one after the other.  All workers end with the block, also after Ctrl-C.  On Linux, all workers
    also end if this process is killed.

    Raises:
        WorkerDied: A worker was killed, for example for lack of memory.
    """
    if min(jobs, count) < 2 or not hasattr(os, "fork"):
        yield ((index, function(index)) for index in range(count))
        return
    _WORK["function"] = function
    try:
        with process_pool(min(jobs, count)) as pool:
            yield _finished([pool.submit(_worker, index) for index in range(count)])
    finally:
        _WORK.clear()


def _finished(futures: list[Future[tuple[int, _Result]]]) -> Iterator[tuple[int, _Result]]:
    try:
        yield from (future.result() for future in as_completed(futures))
    except BrokenExecutor:
        raise WorkerDied() from None


class Copy(Generic[_Result]):
    """A copy of this process that sends results.

    Attributes:
        process: The process.
        receiver: Pipe through which the results come.
    """

    def __init__(self, process: BaseProcess, receiver: Any) -> None:
        self.process, self.receiver = process, receiver

    def receive(self) -> _Result:
        """Wait for the next result; raise the error of the copy, or ``WorkerDied`` if the copy was killed."""
        try:
            error, result = self.receiver.recv()
        except (EOFError, ConnectionResetError):
            raise WorkerDied() from None
        if error is not None:
            raise error
        return cast(_Result, result)


@contextmanager
def fork_call(function: Callable[[], _Result]) -> Iterator[Callable[[], _Result]]:
    """Start ``function()`` in a copy of this process and yield a function that waits for its result.

    Only a fork can copy the state of physics engines and solvers.  Exceptions in the copy are raised in this process.
    The copy ends at the end of the ``with`` block.

    Raises:
        OSError: The system cannot fork.
        WorkerDied: The copy was killed, for example for lack of memory.
    """
    if not hasattr(os, "fork"):
        raise OSError("the system cannot fork")
    with fork_stream(lambda: iter([function()])) as copy:
        yield copy.receive


@contextmanager
def fork_stream(results: Callable[[], Iterator[_Result]]) -> Iterator[Copy[_Result]]:
    """Start a copy of this process that sends each of ``results()``; the copy ends with the block."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    copy = multiprocessing.get_context("fork").Process(target=_copy, args=(results, receiver, sender, os.getpid()))
    with receiver:
        with sender, signals_held():
            copy.start()
        try:
            yield Copy(copy, receiver)
        finally:
            _end([copy])


def _copy(results: Callable[[], Iterator[Any]], receiver: Any, sender: Any, parent: int) -> NoReturn:
    """Send the results, or the error that ends them, to the parent process; end the process without clean-up."""
    receiver.close()
    depend(parent)
    # With SIGTERM, the copy removes its temporary folders before it ends.
    _HELD[0] = 0
    signal.signal(signal.SIGTERM, lambda *_: end_early(lambda: os._exit(1)))
    try:
        try:
            for result in results():
                sender.send((None, result))
        except BaseException as error:
            sender.send((error, None))
    finally:
        os._exit(0)


def depend(parent: int) -> None:
    """Make a forked process end with its parent, and ignore signals except SIGTERM, because SIGTERM ends workers."""
    for number in ENDING:
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
