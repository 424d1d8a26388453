"""Work that is shared among forked processes, and what a process does twice from one state."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.pool import Pool
from typing import Any, NoReturn, TypeVar

_Result = TypeVar("_Result")

# Workers are forked and find the function here: what it holds (a CasADi solver) cannot be sent to them.
_WORK: dict[str, Callable[[int], Any]] = {}


def _worker(index: int) -> tuple[int, Any]:
    return index, _WORK["function"](index)


@contextmanager
def shared_out(function: Callable[[int], _Result], count: int, jobs: int) -> Iterator[Iterator[tuple[int, _Result]]]:
    """``(index, function(index))`` for each index below ``count``, as they finish.

    In forked processes where ``jobs`` is more than one and the system can fork; else one after the other, here.  When
    the block is left, in peace or by Ctrl-C, no process is left running.
    """
    if min(jobs, count) < 2 or "fork" not in multiprocessing.get_all_start_methods():
        yield ((index, function(index)) for index in range(count))
        return
    _WORK["function"] = function
    # Ctrl-C reaches every process of the terminal's group: workers must never see it, not even at birth.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        pool: Pool = multiprocessing.get_context("fork").Pool(min(jobs, count), initializer=_ignore_interrupt)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield pool.imap_unordered(_worker, range(count))
    finally:
        pool.terminate()
        pool.join()
        _WORK.clear()


@contextmanager
def in_a_copy(function: Callable[[], _Result]) -> Iterator[Callable[[], _Result]]:
    """Begin ``function()`` in a copy of this process, at the very state that it is in; yield what waits for its end.

    For state that cannot be copied otherwise (physics, solvers).  The copy's exceptions are raised here.  When the
    block is left, the copy is gone.

    Raises:
        OSError: The system cannot fork.
    """
    reader, writer = multiprocessing.Pipe(duplex=False)
    child = os.fork()
    if child == 0:
        _answer(function, writer)
    writer.close()

    def collect() -> _Result:
        try:
            good, answer = reader.recv()
        except EOFError:
            raise OSError("a process that was forked has died") from None
        if not good:
            raise answer
        result: _Result = answer
        return result

    try:
        yield collect
    finally:
        reader.close()
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _answer(function: Callable[[], Any], writer: Any) -> NoReturn:
    """Live as a copy: send what comes, and end without any of the original's clean-up."""
    try:
        try:
            answer = (True, function())
        except BaseException as error:
            answer = (False, error)
        writer.send(answer)
    finally:
        os._exit(0)


def _ignore_interrupt() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
