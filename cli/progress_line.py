"""Progress line on standard error, if standard error is a terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

# Seconds between two drawings of the line.
_REFRESH = 0.1
# Seconds after which a pace is known.
_PACE = 2.0


@contextmanager
def progress(
    doing: str, unit: str = "", *, shown: bool, first: str = ""
) -> Iterator[Callable[[int, int], None] | None]:
    """Show what the program is doing while the block runs.

    The line shows what the library tells (:func:`impact_posture.system.progress.tell`) and what the block counts.
    Yield the function that takes ``(done, all)``; ``None`` where nothing is shown.  Without the ``unit`` of a count,
    the line shows a bar and no numbers.  Until the first count, it shows ``first`` instead of ``doing``.
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

    # No thread redraws the line: worker processes are forked meanwhile, and long calls of C hold Python's lock.
    words = TextColumn("{task.description}", markup=False)
    columns = (words, BarColumn(), TextColumn("{task.fields[count]}"), TimeElapsedColumn())
    line = Progress(*columns, console=console, transient=True, auto_refresh=False)
    task = line.add_task(f"{first or doing} …", total=None, count="")
    drawn, last = 0.0, ""
    # When the first count came, and what was done by then: an earlier run may have done it.
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

    # The line hides the cursor; a signal that ends the process must show it again.
    with undone(line.stop), listening(show), line:
        line.refresh()
        yield advance


def _time_left(took: float, done: int, left: int) -> str:
    """Return an estimate of the time left, from the pace so far; nothing before there is a pace."""
    if took < _PACE or not (done and left):
        return ""
    return f", {timedelta(seconds=math.ceil(took / done * left))} left"
