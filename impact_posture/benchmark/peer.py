"""One way of computing H and ∇H, as the harness calls it."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Literal

from impact_posture.benchmark.count import Operations

Group = Literal["ours", "pinocchio", "adam", "casadi", "differences"]


@dataclass(frozen=True)
class Peer:
    """A kernel and what it cost to make.

    Attributes:
        name: Row of the table.
        group: Whose it is.
        what: The name in words.
        eval: Address of ``int f(q, n, H, grad)``, or ``None``.
        value: Address of ``int f(q, n, H)``, or ``None``.
        flags: Compiler and its options, without the folders of headers.
        compile_s: Processor seconds of the compiler.
        library: Kept alive.
        batch: Address of ``int f(q, n, count, H, grad)``, or ``None``.
        operations: Of ``eval``; ``None`` where it is a library of templates.
        source_kb: Size of the source that ``eval`` is in, kB; ``None`` likewise.
        eval_kb: What ``eval`` calls of it.
        by_differences: Whether ∇H is by central differences of ``value`` instead of by ``eval``.
        tolerance: Largest relative difference from the oracle with which its time means anything.
    """

    name: str
    group: Group
    what: str
    eval: ctypes.c_void_p | None
    value: ctypes.c_void_p | None
    flags: str
    compile_s: float
    library: ctypes.CDLL
    batch: ctypes.c_void_p | None = None
    operations: Operations | None = None
    source_kb: float | None = None
    eval_kb: float | None = None
    by_differences: bool = False
    tolerance: float = 1e-6
