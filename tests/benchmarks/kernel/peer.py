"""One way of computing H and ∇H, as the harness calls it."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from tests.benchmarks.kernel.count import Operations


@dataclass(frozen=True)
class Peer:
    """A kernel and what it cost to make.

    Attributes:
        name: Row of the table.
        eval: Address of ``int f(q, n, H, grad)``, or ``None``.
        value: Address of ``int f(q, n, H)``, or ``None``.
        batch: Address of ``int f(q, n, count, H, grad)``, or ``None``.
        flags: The compiler's command.
        operations: In the source of ``eval``; ``None`` where it is a library of templates.
        source_kb: Size of the source that ``eval`` is in, and of what ``eval`` calls there, kB; ``None`` likewise.
        compile_s: Processor seconds of the compiler.
        library: Kept alive.
    """

    name: str
    eval: ctypes.c_void_p | None
    value: ctypes.c_void_p | None
    flags: str
    compile_s: float
    library: ctypes.CDLL
    batch: ctypes.c_void_p | None = None
    operations: Operations | None = None
    source_kb: tuple[float, float] | None = None
