"""Report of progress: long computations tell a listener what they are doing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Takes the activity and the share of it that is done; ``None`` for an unknown share.
Listener = Callable[[str, float | None], None]

_LISTENERS: list[Listener] = []
# A forked process must not write on the terminal of its parent.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_LISTENERS.clear)


def tell(doing: str, share: float | None = None) -> None:
    """Tell the current listener, if any, what is being done and the share that is done."""
    if _LISTENERS:
        _LISTENERS[-1](doing, share)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send reports to ``listener`` within the block."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.pop()
