"""What the process makes of its surroundings: signals, closed streams, settings meant for other programs."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from functools import partial

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "the terminal was closed"}
_SEEN: list[int] = []
# Below this limit on the address space OpenBLAS may wait forever for memory while SciPy is imported.
_LEAST_MEMORY = 1 << 30


def prepare() -> None:
    """Make the process safe to run and to end.  For the entry point alone: it changes the whole process."""
    _open_streams()
    # A notebook's backend, or one that does not exist, must not end what only writes files.
    os.environ["MPLBACKEND"] = "agg"
    # Matrices are small here: threads of the linear algebra only take memory, and fail to start where it is scarce.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for number in _WORDS:
        # What is ignored stays so: nohup, and a shell's jobs in the background.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def finish() -> None:
    """Take no more signals: all is done, and the interpreter gives their default back while it ends."""
    for number in _WORDS:
        signal.signal(number, signal.SIG_IGN)


def memory_fault() -> str:
    """What is wrong with the limit on the process's memory; empty for nothing."""
    if sys.platform == "win32":
        return ""
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= _LEAST_MEMORY:
        return ""
    return (
        f"ulimit -v: the process may use {limit >> 20} MB of address space; allow at least {_LEAST_MEMORY >> 20} MB"
    )


def _open_streams() -> None:
    """Put nothing in the place of closed streams: a file opened later must not become standard output."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            # The lowest number that is free, which is this one.
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def _end(number: int, frame: object) -> None:
    """End at once, cleanly; not by an exception, which C++ libraries swallow.  A second signal skips the cleaning."""
    library = sys.modules.get("impact_posture.processes")
    leave = partial(_leave, number)
    if library is None or _SEEN:
        leave()
    _SEEN.append(number)
    library.end_early(leave)  # type: ignore[union-attr]


def _leave(number: int) -> None:
    kind = "Interrupted" if number == signal.SIGINT else "Terminated"
    os._exit(refuse(_WORDS[signal.Signals(number)], 128 + number, kind))


def refuse(what: str, code: int = 1, kind: str = "MemoryError") -> int:
    """Write an error before, or instead of, everything else, and return its code."""
    with suppress(OSError):
        os.write(2, f"error: {what}\n".encode())
        if "--json" in sys.argv:
            # Not through sys.stdout: a signal may have come while it was written to.
            content = f'{{"code": {code}, "kind": "{kind}", "what": "{what}", "where": "", "hint": ""}}'
            os.write(1, f'{{"error": {content}}}\n'.encode())
    return code
