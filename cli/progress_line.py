"""Progress line on standard error, if standard error is a terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

# Minimum time between two updates with the same text, s.
_REFRESH = 0.1
# The line shows no estimate of the remaining time before this time, s.
_PACE = 2.0


@contextmanager
def progress(
    doing: str, unit: str = "", *, shown: bool, first: str = ""
) -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress line while the block runs.

    The line shows the messages of the library (:func:`impact_posture.system.progress.tell`) and the progress that the
    block reports.  To report, the block calls the yielded function with ``(done, all)``.  If no line is shown,
    ``None`` is yielded.  If ``unit`` is empty, the line shows a bar but no numbers.  Before the first report, the
    line shows ``first`` instead of ``doing``.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if not (shown and console.is_terminal):
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from impact_posture.errors import printable
    from impact_posture.system.processes import undone
    from impact_posture.system.progress import listening

    # Do not update the line in a thread, because worker processes are forked during the block.  Also, long calls of C
    # code block all Python threads.
    words = TextColumn("{task.description}", markup=False)
    columns = (words, BarColumn(), TextColumn("{task.fields[count]}"), TimeElapsedColumn())
    line = Progress(*columns, console=console, transient=True, auto_refresh=False)
    task = line.add_task(f"{first or doing} …", total=None, count="")
    drawn, last = 0.0, ""
    # Time of the first report, and the work that was done before it, possibly by an earlier run.
    began: tuple[float, int] | None = None

    def show(text: str, share: float | None = None) -> None:
        nonlocal drawn, last
        now = time.monotonic()
        if text == last and now - drawn < _REFRESH:
            return
        drawn, last = now, text
        line.update(task, description=printable(text), completed=share or 0.0, total=None if share is None else 1.0)
        line.refresh()

    def advance(done: int, total: int) -> None:
        nonlocal began
        began = began or (time.monotonic(), done)
        left = _time_left(time.monotonic() - began[0], done - began[1], total - done)
        if unit:
            line.update(task, count=f"{done}/{total} {unit}{left}")
        show(doing, done / total)

    # The progress line hides the cursor.  If a signal ends the process, ``line.stop`` shows the cursor again.
    with undone(line.stop), listening(show), line:
        line.refresh()
        yield advance


def _time_left(took: float, done: int, left: int) -> str:
    """Return the remaining time as text, estimated from the speed so far; empty if an estimate is not possible."""
    if took < _PACE or not (done and left):
        return ""
    return f", {timedelta(seconds=math.ceil(took / done * left))} left"
