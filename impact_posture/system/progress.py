"""Report the progress of long jobs to a listener."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# A listener takes the present activity and the finished share of it, or ``None`` if the share is unknown.
Listener = Callable[[str, float | None], None]

_LISTENERS: list[Listener] = []
# A forked process must not write to the terminal of its parent.
os.register_at_fork(after_in_child=_LISTENERS.clear)


def tell(doing: str, share: float | None = None) -> None:
    """Report to the listener, if there is one."""
    if _LISTENERS:
        _LISTENERS[-1](doing, share)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Report to ``listener`` within the block."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.pop()
