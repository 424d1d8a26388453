"""Set up the process: handle signals, closed streams, environment variables and the memory limit."""

from __future__ import annotations

import gc
import os
import re
import resource
import signal
import sys
from contextlib import suppress
from functools import partial
from typing import NoReturn

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "the terminal was closed"}
_SEEN: list[int] = []
# Below this limit on the address space, bytes, OpenBLAS may wait forever for memory while SciPy is imported.
_LEAST_MEMORY = 1 << 30


def prepare() -> None:
    """Set up streams, environment and signals of the process; only the entry point may call this function."""
    _open_streams()
    # Let the program read and remove its own files.  A umask such as 777 would prevent this.
    os.umask(os.umask(0o077) & 0o077)
    # Always use the file backend, because a notebook backend or a missing backend in the environment would fail.
    os.environ["MPLBACKEND"] = "agg"
    # NumPy and Matplotlib fail if the date of a reproducible build is not a number.  No output contains a date.
    os.environ.pop("SOURCE_DATE_EPOCH", None)
    # Rich takes the line width from COLUMNS.  A huge width fills the memory, and lines of width zero are empty.
    if not re.fullmatch(r"[1-9]\d{0,3}", os.environ.get("COLUMNS", "80")):
        del os.environ["COLUMNS"]
    # Threads of the linear algebra do not help with small matrices, but they use memory and can fail to start.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for number in _WORDS:
        # Signals that the parent ignores stay ignored, for example under nohup or in a background job of a shell.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def finish(code: int) -> NoReturn:
    """End the process with an exit code.

    Signals are ignored from now on.  Otherwise, a signal would have its default effect while the interpreter ends.
    """
    for number in _WORDS:
        signal.signal(number, signal.SIG_IGN)
    # Without this call, the interpreter would free the expressions of a large robot, which takes 0.3 s.
    gc.freeze()
    sys.exit(code)


def memory_fault() -> str:
    """Return an error message if the memory limit of the process is too low; otherwise, return an empty text."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= _LEAST_MEMORY:
        return ""
    least = _LEAST_MEMORY >> 20
    return f"ulimit -v: the process may use {limit >> 20} MB of address space; allow at least {least} MB"


def _open_streams() -> None:
    """Open the null device for each closed standard stream.

    Otherwise, the next opened file would get the descriptor of this stream, and output would be written to this file.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            # The system assigns the lowest free descriptor, which is the descriptor of the closed stream.
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def _end(number: int, frame: object) -> None:
    """Clean up and end the process at once, without an exception, because C++ libraries may catch exceptions.

    After a second signal, end without cleaning up.
    """
    # Before ``processes`` is imported, there is nothing to clean up.
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
    """Write an error message without Typer, and return its exit code."""
    with suppress(OSError):
        os.write(2, f"error: {what}\n".encode())
        if "--json" in sys.argv:
            # Do not use sys.stdout, because the signal may have interrupted a write to it.
            content = f'{{"code": {code}, "kind": "{kind}", "what": "{what}", "where": "", "hint": ""}}'
            os.write(1, f'{{"error": {content}}}\n'.encode())
    return code
