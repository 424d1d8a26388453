"""Report the progress of long jobs to a listener."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Function that gets the current activity and its finished share, or ``None`` if the share is unknown.
Listener = Callable[[str, float | None], None]

_LISTENERS: list[Listener] = []
# Clear the listeners in a forked process, because it must not write to the terminal of its parent.
os.register_at_fork(after_in_child=_LISTENERS.clear)


def tell(doing: str, share: float | None = None) -> None:
    """Report an activity and its finished share to the listener, if a listener is set."""
    if _LISTENERS:
        _LISTENERS[-1](doing, share)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send reports to ``listener`` inside the block."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.pop()
