"""Checks that all kernels agree, then times them in turns on one core."""

from __future__ import annotations

import ctypes
import os
import statistics
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from impact_posture.benchmark.case import FEW, STEP, Case, Vector
from impact_posture.benchmark.peer import Peer
from impact_posture.benchmark.workbench import HERE, Workbench, c_compiler

# A warm pass right before each: another peer's code has just filled the caches.
_WARM = 16
# First rounds that do not count.
_UNCOUNTED = 2
_KINDS = ("eval", "value", "batch", "differences")


class Disagreement(Exception):
    """A peer that computes other numbers; its time means nothing."""


@dataclass(frozen=True)
class Times:
    """Median seconds a configuration; ``None`` for what the peer does not have."""

    eval: float | None
    value: float | None
    batch: float | None


@contextmanager
def one_core() -> Iterator[int | None]:
    """Keep this process on one core; ``None`` where the system cannot."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    core = max(allowed)
    os.sched_setaffinity(0, {core})
    try:
        yield core
    finally:
        os.sched_setaffinity(0, allowed)


class Loops:
    """The C loops of ``harness.c``: thread's processor seconds a configuration.

    Configurations are rows of shape (N, nq), normals of shape (N, 3), gradients go to shape (N, nv), values to (N,);
    all of them contiguous doubles.

    Attributes:
        failed: How many calls returned an error code so far.
    """

    def __init__(self, bench: Workbench) -> None:
        """Build them.

        Raises:
            Absent: The C compiler failed.
            CompilerError: There is none.
        """
        source = {"harness.c": (HERE / "harness.c").read_text()}
        self._library = bench.build("the loops", source, c_compiler(), ["-std=c99", "-O2"]).library
        for name in ("time_eval", "time_value", "time_batch", "time_differences"):
            getattr(self._library, name).restype = ctypes.c_double
        self._failed = ctypes.c_int(0)

    @property
    def failed(self) -> int:
        """Calls that returned an error code."""
        return self._failed.value

    def eval(self, function: ctypes.c_void_p, q: Vector, n: Vector, H: Vector, grad: Vector) -> float:
        """One call of ``f(q, n, H, grad)`` a row."""
        return self._run("eval", function, q, n, q.shape[1], grad.shape[1], len(q), H, grad)

    def value(self, function: ctypes.c_void_p, q: Vector, n: Vector, H: Vector) -> float:
        """One call of ``f(q, n, H)`` a row."""
        return self._run("value", function, q, n, q.shape[1], len(q), H)

    def batch(self, function: ctypes.c_void_p, q: Vector, n: Vector, H: Vector, grad: Vector) -> float:
        """One call of ``f(q, n, count, H, grad)`` for all rows."""
        return self._run("batch", function, q, n, len(q), H, grad)

    def differences(self, function: ctypes.c_void_p, moved: Vector, n: Vector, H: Vector, grad: Vector) -> float:
        """Calls of ``f(q, n, H)`` at rows ``moved``, shape (N, 1 + 2 nv, nq): H and central differences of it."""
        count, rows, nq = moved.shape
        step = ctypes.c_double(STEP)
        return self._run("differences", function, moved, n, nq, (rows - 1) // 2, count, step, H, grad)

    def _run(self, kind: str, function: ctypes.c_void_p, *arguments: Vector | int | ctypes.c_double) -> float:
        given = [ctypes.c_void_p(a.ctypes.data) if isinstance(a, np.ndarray) else a for a in arguments]
        return float(getattr(self._library, f"time_{kind}")(function, *given, ctypes.byref(self._failed)))


class Harness:
    """The loops over one case's configurations."""

    def __init__(self, case: Case, bench: Workbench) -> None:
        """Build the loops; errors as :class:`Loops`."""
        self._loops = Loops(bench)
        self._case = case
        self._q = np.ascontiguousarray(case.q)
        self._n = np.ascontiguousarray(case.n)
        self._H = np.zeros(len(self._q))
        self._grad = np.zeros((len(self._q), case.robot.nv))

    def check(self, peer: Peer) -> float:
        """Largest relative difference of H and ∇H (against its largest entry) from the oracle, over all calls.

        Raises:
            Disagreement: Above the peer's tolerance, or a call that returned an error code.
        """
        H, gradient = self._case.reference
        worst, failed = 0.0, self._loops.failed
        for kind in _KINDS:
            if not self._has(peer, kind):
                continue
            self._H[:], self._grad[:] = np.nan, np.nan
            self._pass(peer, kind)
            few = FEW if kind == "differences" else len(H)
            worst = self._worst(worst, H[:few], None if kind == "value" else gradient[:few])
        if self._loops.failed > failed:
            raise Disagreement(f"{self._loops.failed - failed} calls returned an error code")
        # Not ">": that is false for a NaN.
        if not worst <= peer.tolerance:
            raise Disagreement(f"its numbers differ from Pinocchio's by {worst:.1e}, relative")
        return worst

    def _worst(self, so_far: float, H: Vector, gradient: Vector | None) -> float:
        found = [so_far, *np.abs(self._H[: len(H)] / H - 1)]
        if gradient is not None:
            scale = np.maximum(np.abs(gradient).max(axis=1), 1e-3 * np.abs(H))
            found += list(np.abs(self._grad[: len(H)] - gradient).max(axis=1) / scale)
        # np.max keeps a NaN, which max() may drop.
        return float(np.max(found))

    def times(self, peers: Sequence[Peer], rounds: int) -> list[Times]:
        """Medians over ``rounds`` passes; the peers take turns within a round.

        Raises:
            Disagreement: A call returned an error code.
        """
        passes: dict[tuple[int, str], list[float]] = {}
        for number in range(rounds + _UNCOUNTED):
            for index, peer in enumerate(peers):
                for kind in _KINDS:
                    if self._has(peer, kind):
                        # After one that does not count: a loop of its own, not the refill of caches that the peer
                        # before it has taken.
                        self._pass(peer, kind)
                        took = self._pass(peer, kind)
                        if number >= _UNCOUNTED:  # caches and clocks warm first
                            passes.setdefault((index, kind), []).append(took)
        if self._loops.failed:
            raise Disagreement(f"{self._loops.failed} calls returned an error code")
        median = {key: statistics.median(values) for key, values in passes.items()}
        return [
            Times(median.get((k, "eval"), median.get((k, "differences"))), median.get((k, "value")),
                  median.get((k, "batch")))
            for k in range(len(peers))
        ]  # fmt: skip

    @staticmethod
    def _has(peer: Peer, kind: str) -> bool:
        if peer.by_differences or kind == "differences":
            return peer.by_differences and kind == "differences"
        return getattr(peer, kind) is not None

    def _pass(self, peer: Peer, kind: str) -> float:
        q, n, H, grad = self._q, self._n, self._H, self._grad
        if kind == "differences" and peer.value is not None:
            return self._loops.differences(peer.value, self._case.moved, n, H, grad)
        if kind == "batch" and peer.batch is not None:
            return self._loops.batch(peer.batch, q, n, H, grad)
        if kind == "value" and peer.value is not None:
            return self._loops.value(peer.value, q, n, H)
        if peer.eval is None:
            raise ValueError(f"{peer.name} has no {kind}")
        self._loops.eval(peer.eval, q[:_WARM], n[:_WARM], H, grad)
        return self._loops.eval(peer.eval, q, n, H, grad)
