"""Setup of the process: signals, closed streams, environment variables, limit on the memory."""

from __future__ import annotations

import os
import resource
import signal
import sys
from contextlib import suppress
from functools import partial
from typing import NoReturn

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "the terminal was closed"}
_SEEN: list[int] = []
# Below this limit on the address space OpenBLAS may wait forever for memory while SciPy is imported.
_LEAST_MEMORY = 1 << 30


def prepare() -> None:
    """Make the process safe to run and to end.  Only the entry point calls this, because it changes the process."""
    _open_streams()
    # A backend for notebooks, or a missing backend, must not stop a program that only writes files.
    os.environ["MPLBACKEND"] = "agg"
    # The matrices are small. Threads of the linear algebra take memory, and fail to start where memory is scarce.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for number in _WORDS:
        # Ignored signals stay ignored: by nohup, and for background jobs of a shell.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def finish(code: int) -> NoReturn:
    """End with an exit code, and ignore signals from now on, because the interpreter restores their default."""
    for number in _WORDS:
        signal.signal(number, signal.SIG_IGN)
    sys.exit(code)


def memory_fault() -> str:
    """Say what is wrong with the memory limit of the process; empty if nothing is."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= _LEAST_MEMORY:
        return ""
    least = _LEAST_MEMORY >> 20
    return f"ulimit -v: the process may use {limit >> 20} MB of address space; allow at least {least} MB"


def _open_streams() -> None:
    """Open the null device for closed streams, so that no file opened later becomes standard output."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            # The system takes the lowest free number, which is this number.
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def _end(number: int, frame: object) -> None:
    """End at once after cleaning up, without an exception, because C++ libraries swallow exceptions.

    A second signal skips the cleaning.
    """
    # A signal may come while the module is imported; then nothing has begun that would need cleaning.
    end_early = getattr(sys.modules.get("impact_posture.system.processes"), "end_early", None)
    leave = partial(_leave, number)
    if end_early is None or _SEEN:
        leave()
        return
    _SEEN.append(number)
    end_early(leave)


def _leave(number: int) -> None:
    kind = "Interrupted" if number == signal.SIGINT else "Terminated"
    os._exit(refuse(_WORDS[signal.Signals(number)], 128 + number, kind))


def refuse(what: str, code: int = 1, kind: str = "MemoryError") -> int:
    """Write an error without Typer and return its exit code."""
    with suppress(OSError):
        os.write(2, f"error: {what}\n".encode())
        if "--json" in sys.argv:
            # Not through sys.stdout, because a signal may have interrupted a write to it.
            content = f'{{"code": {code}, "kind": "{kind}", "what": "{what}", "where": "", "hint": ""}}'
            os.write(1, f'{{"error": {content}}}\n'.encode())
    return code
