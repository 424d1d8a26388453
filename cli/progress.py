"""What is being done, on standard error, while something takes long; nothing where that is no terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Seconds from one picture of the line to the next.
_REFRESH = 0.1


@contextmanager
def progress_bar(
    doing: str, what: str = "", *, shown: bool, first: str = ""
) -> Iterator[Callable[[int, int], None] | None]:
    """Yield what is told of ``(done, all)``; ``None`` where nothing is to be shown.

    Args:
        doing: What is being done.
        what: What is counted.
        shown: Whether to show anything.
        first: What is being done until the first is done; ``doing`` if empty.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if not (shown and console.is_terminal):
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from impact_posture.processes import undone

    counted = (MofNCompleteColumn(), TextColumn(what)) if what else ()
    text = TextColumn("{task.description}")
    # No thread redraws it: worker processes are forked meanwhile, and what takes long in C holds Python's lock.
    bar = Progress(text, console=console, transient=True, auto_refresh=False)
    task = bar.add_task(f"{first or doing} …", total=None)

    def advance(done: int, total: int) -> None:
        bar.columns = (text, BarColumn(), *counted, TimeElapsedColumn())
        bar.update(task, description=doing, completed=done, total=total, refresh=True)

    # Also when a signal ends the process: the bar hides the cursor.
    with undone(bar.stop), bar:
        bar.refresh()
        yield advance


@contextmanager
def progress_line(*, shown: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show on a line of standard error what the library is at, and how many runs are done; on a terminal only.

    Yield what is told of ``(done, all)`` runs; ``None`` where nothing is to be shown.
    """
    from rich.console import Console

    console = Console(stderr=True)
    if not (shown and console.is_terminal):
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn

    from impact_posture.escape import printable
    from impact_posture.progress import listening

    # Drawn when something is told, by no thread of its own: runs fork.
    words = TextColumn("{task.description}", markup=False)
    columns = (words, BarColumn(), TextColumn("{task.fields[runs]}"))
    line = Progress(*columns, console=console, transient=True, auto_refresh=False)
    task = line.add_task("", total=None, runs="")
    drawn, last = 0.0, ""

    def show(doing: str, share: float | None = None) -> None:
        nonlocal drawn, last
        now = time.monotonic()
        if doing == last and now - drawn < _REFRESH:
            return
        drawn, last = now, doing
        line.update(task, description=printable(doing), completed=share or 0.0, total=None if share is None else 1.0)
        line.refresh()

    def advance(done: int, total: int) -> None:
        line.update(task, runs=f"{done}/{total} runs")
        show("running", done / total)

    with listening(show), line:
        yield advance
