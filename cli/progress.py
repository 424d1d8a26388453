"""What is being done, on standard error, while something takes long; nothing where that is no terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
    if not shown:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    counted = (MofNCompleteColumn(), TextColumn(what)) if what else ()
    text = TextColumn("{task.description}")
    # No thread redraws it: worker processes are forked meanwhile, and what takes long in C holds Python's lock.
    bar = Progress(text, console=Console(stderr=True), transient=True, auto_refresh=False)
    task = bar.add_task(f"{first or doing} …", total=None)

    def advance(done: int, total: int) -> None:
        bar.columns = (text, BarColumn(), *counted, TimeElapsedColumn())
        bar.update(task, description=doing, completed=done, total=total, refresh=True)

    with bar:
        bar.refresh()
        yield advance
