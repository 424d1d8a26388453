"""Call C++ libraries in a copy of this process, because a damaged file may crash them, or occupy them for hours."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from impact_posture.errors import ImpactPostureError, WorkerDied
from impact_posture.system.processes import Copy, fork_stream

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

# Memory that the calls may allocate, bytes: 1.5 times the memory for the largest mesh file.
MOST_MEMORY = 3 << 30
# If a call sleeps longer than this, s, it waits for a pipe or a device.  A process that waits for a disk does not
# sleep, except with FUSE.
_LONGEST_SLEEP = 1.0
# Linux function in which a process sleeps while it waits for a file system of FUSE, such as sshfs.
_FUSE = "request_wait_answer"
_TOO_LARGE = "takes too much memory to read"
# Time between two checks of a running call, s.
_PAUSE = 0.2


class CallFailed(ImpactPostureError):
    """A call crashed or exceeded a limit.  A repetition may succeed, for example on a faster machine."""


class CallTimedOut(CallFailed):
    """A call exceeded its processor time."""


class _Outcome(NamedTuple, Generic[_Result]):
    """Result or exception of a call; ``last`` is true if the forked process cannot make another call."""

    result: _Result | Exception
    last: bool


def isolated_calls(
    function: Callable[[_Item], _Result], items: Sequence[_Item], seconds: Callable[[_Item], float]
) -> Iterator[_Result | Exception]:
    """Yield ``function(item)`` for each item, or the exception of the call.

    The calls run one after the other in a copy of this process, and their error output is discarded.  If a call ends
    the copy, a new copy continues with the next item.  Each call may use ``seconds(item)`` of processor time, and all
    calls together may use :data:`MOST_MEMORY`.  The signal handlers of this process run while a call waits for a
    file.

    Raises:
        ImpactPostureError: The system cannot start a process.
    """
    if multiprocessing.current_process().daemon:  # A daemon, such as a cluster worker, must not fork.
        yield from (_result(function, item) for item in items)
        return

    def outcomes() -> Iterator[_Outcome[_Result]]:
        # The parent process reports crashes of this copy.
        faulthandler.disable()
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        _limit(resource.RLIMIT_CORE, 0)
        if before := _memory():
            _limit(resource.RLIMIT_AS, before + MOST_MEMORY)
        for item in items[done:]:
            # After this processor time, the signal SIGPROF ends the copy.
            signal.setitimer(signal.ITIMER_PROF, seconds(item))
            result = _result(function, item)
            yield _Outcome(result, _memory() > before + MOST_MEMORY // 4)

    done = 0
    while done < len(items):
        try:
            with fork_stream(outcomes) as copy:
                for item in items[done:]:
                    done += 1
                    outcome = _received(copy, seconds(item))
                    yield outcome.result
                    if outcome.last:
                        break
        except OSError as error:
            hint = "end other processes, or raise the limits (ulimit -u, ulimit -n)"
            raise ImpactPostureError(f"no process can be started ({error.strerror})", hint=hint) from None


def isolated_call(function: Callable[[], _Result], seconds: float) -> _Result:
    """Return ``function()``, called in a copy of this process with the limits of :func:`isolated_calls`.

    Raises:
        CallFailed: The call crashed or exceeded a limit.
    """
    (outcome,) = isolated_calls(lambda _: function(), [None], lambda _: seconds)
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _result(function: Callable[[_Item], _Result], item: _Item) -> _Result | Exception:
    try:
        return function(item)
    except Exception as error:
        return error


def _received(copy: Copy[_Outcome[_Result]], seconds: float) -> _Outcome[_Result]:
    """Return the next outcome of a copy, or a :class:`CallFailed` if it sends none."""
    used, since = -1, time.monotonic()
    while not copy.receiver.poll(_PAUSE):
        sleeps, now = _activity(copy.process.pid)
        if not sleeps or now != used:
            used, since = now, time.monotonic()
        elif time.monotonic() > since + _LONGEST_SLEEP:
            copy.process.kill()
            return _Outcome(CallFailed("names a pipe or a device, which is not read"), True)
    try:
        outcome = copy.receive()
        return _Outcome(CallFailed(_TOO_LARGE), True) if isinstance(outcome.result, MemoryError) else outcome
    except MemoryError:  # The forked process could not send its result.
        return _Outcome(CallFailed(_TOO_LARGE), True)
    except WorkerDied:
        copy.process.join()
    if copy.process.exitcode == -signal.SIGPROF:
        return _Outcome(CallTimedOut(f"takes more than {seconds:.2g} s to read"), True)
    why = _TOO_LARGE if copy.process.exitcode == -signal.SIGKILL else "crashes its reader"
    return _Outcome(CallFailed(why), True)


def _activity(pid: int | None) -> tuple[bool, int]:
    """Return whether a process sleeps without waiting for a disk, and its processor time in clock ticks.

    On systems other than Linux, the result is ``(False, 0)``.
    """
    process = Path(f"/proc/{pid}")
    try:
        fields = (process / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        # The system may hide the function in which a process sleeps.  It is then "0".
        sleeps = fields[0] == "S" and (process / "wchan").read_text(encoding="utf-8") != _FUSE
    except OSError:
        return False, 0
    return sleeps, int(fields[11]) + int(fields[12])


def _memory() -> int:
    """Return the address space of this process, bytes; 0 on systems other than Linux, where it is not limited."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    except OSError:
        return 0


def _limit(kind: int, value: int) -> None:
    """Set a limit of this process, at most to the limit that the user has set."""
    most = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if most == resource.RLIM_INFINITY else min(value, most), most))
