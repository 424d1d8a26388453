"""Whoever waits is told what takes so long: the library tells, and the one that listens shows it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Of what is being done, and the share of it that is done; ``None`` where nobody knows.
Listener = Callable[[str, float | None], None]

_LISTENERS: list[Listener] = []
# A forked copy must not write on the original's terminal.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_LISTENERS.clear)


def tell(doing: str, share: float | None = None) -> None:
    """Tell the listener, where there is one."""
    if _LISTENERS:
        _LISTENERS[-1](doing, share)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Let ``listener`` be told within the block."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.pop()
