"""A bar on standard error while something takes long."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(doing: str, what: str = "", *, shown: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Yield what is told of ``(done, all)``; ``None`` where nothing is to be shown."""
    if not shown:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from impact_posture.processes import undone

    counted = (MofNCompleteColumn(), TextColumn(what)) if what else ()
    columns = (TextColumn(doing), BarColumn(), *counted, TimeElapsedColumn())
    # The bar starts with the first result: worker processes are forked before its thread runs.
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(doing, total=None)

    def advance(done: int, total: int) -> None:
        bar.start()
        bar.update(task, completed=done, total=total)

    # Also when a signal ends the process: the bar hides the cursor.
    with undone(bar.stop):
        yield advance
