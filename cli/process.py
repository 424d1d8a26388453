"""What the process makes of its surroundings: signals, closed streams, settings meant for other programs."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from functools import partial

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "the terminal was closed"}
_SEEN: list[int] = []


def prepare() -> None:
    """Make the process safe to run and to end.  For the entry point alone: it changes the whole process."""
    _open_streams()
    # A notebook's backend, or one that does not exist, must not end what only writes files.
    os.environ["MPLBACKEND"] = "agg"
    for number in _WORDS:
        # What is ignored stays so: nohup, and a shell's jobs in the background.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


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
    code, words = 128 + number, _WORDS[signal.Signals(number)]
    with suppress(OSError):
        os.write(2, f"error: {words}\n".encode())
        if "--json" in sys.argv:
            # Not through sys.stdout: the signal may have come while it was written to.
            kind = "Interrupted" if number == signal.SIGINT else "Terminated"
            content = f'{{"code": {code}, "kind": "{kind}", "what": "{words}", "where": "", "mend": ""}}'
            os.write(1, f'{{"error": {content}}}\n'.encode())
    os._exit(code)
