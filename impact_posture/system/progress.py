"""Report the progress of long jobs to a listener."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Function with the arguments activity and finished fraction; ``None`` stands for an unknown fraction.
Listener = Callable[[str, float | None], None]

_LISTENERS: list[Listener] = []
# A forked process must not write to the terminal of its parent.
os.register_at_fork(after_in_child=_LISTENERS.clear)


def tell(doing: str, share: float | None = None) -> None:
    """Report an activity and its finished fraction to the newest listener, if there is a listener."""
    if _LISTENERS:
        _LISTENERS[-1](doing, share)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send the reports of :func:`tell` to ``listener`` inside the block."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.pop()
