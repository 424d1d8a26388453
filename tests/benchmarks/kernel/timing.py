"""Checks that all kernels agree, then times them in turns on one core."""

from __future__ import annotations

import ctypes
import os
import statistics
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from tests.benchmarks.kernel.build import HERE, build, c_compiler
from tests.benchmarks.kernel.case import Case, Vector
from tests.benchmarks.kernel.peer import Peer

TOLERANCE = 1e-6


class Disagreement(Exception):
    """A peer that computes other numbers; its time means nothing."""


@dataclass(frozen=True)
class Times:
    """Median seconds a call; ``None`` for what the peer does not have."""

    eval: float | None
    value: float | None
    batch: float | None


@contextmanager
def one_core() -> Iterator[int | None]:
    """Keep this process on the core it finds itself on; ``None`` where the system cannot."""
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


class Harness:
    """The C loop of ``harness.c`` over one case's configurations."""

    def __init__(self, case: Case) -> None:
        source = {"harness.c": (HERE / "harness.c").read_text()}
        self._library = build(source, c_compiler(), ["-std=c99", "-O2"], []).library
        for name in ("time_eval", "time_value", "time_batch"):
            getattr(self._library, name).restype = ctypes.c_double
        self._case = case
        self._q = np.ascontiguousarray(case.q)
        self._n = np.ascontiguousarray(case.n)
        self._H = np.zeros(len(self._q))
        self._grad = np.zeros((len(self._q), case.robot.nv))
        self._failed = ctypes.c_int(0)

    def check(self, peer: Peer, reference: tuple[Vector, Vector]) -> float:
        """Largest relative difference of H and ∇H (against its largest entry) over all configurations.

        Raises:
            Disagreement: Above :data:`TOLERANCE`.
        """
        worst = 0.0
        for k in range(len(self._q)):
            H, gradient = self.call(peer, k)
            scale = max(np.abs(reference[1][k]).max(), 1e-3 * abs(reference[0][k]))
            worst = max(worst, abs(H / reference[0][k] - 1), np.abs(gradient - reference[1][k]).max() / scale)
        if not worst <= TOLERANCE:
            raise Disagreement(f"{peer.name} differs by {worst:.1e}")
        return worst

    def call(self, peer: Peer, k: int) -> tuple[float, Vector]:
        """H and ∇H at configuration ``k``; H by ``value`` too must be the same."""
        H, gradient = np.full(1, np.nan), np.full(self._case.robot.nv, np.nan)
        q, n = np.ascontiguousarray(self._q[k]), np.ascontiguousarray(self._n[k])
        kind = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4)
        assert peer.eval is not None
        kind(peer.eval.value)(q.ctypes.data, n.ctypes.data, H.ctypes.data, gradient.ctypes.data)
        if peer.value is not None:
            alone = np.full(1, np.nan)
            kind3 = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 3)
            kind3(peer.value.value)(q.ctypes.data, n.ctypes.data, alone.ctypes.data)
            if not abs(alone[0] / H[0] - 1) <= TOLERANCE:
                raise Disagreement(f"{peer.name}: H alone differs by {abs(alone[0] / H[0] - 1):.1e}")
        return float(H[0]), gradient

    def times(self, peers: list[Peer], rounds: int) -> list[Times]:
        """Medians over ``rounds`` passes; the peers take turns within a round."""
        passes: dict[tuple[int, str], list[float]] = {}
        for peer_round in range(rounds + 2):
            for index, peer in enumerate(peers):
                for kind in ("eval", "value", "batch"):
                    if getattr(peer, kind) is None:
                        continue
                    took = self._pass(peer, kind)
                    if peer_round >= 2:  # caches and clocks warm first
                        passes.setdefault((index, kind), []).append(took)
        if self._failed.value:
            raise Disagreement(f"{self._failed.value} calls returned an error code")
        median = {key: statistics.median(values) for key, values in passes.items()}
        return [Times(*[median.get((k, kind)) for kind in ("eval", "value", "batch")]) for k in range(len(peers))]

    def _pass(self, peer: Peer, kind: str) -> float:
        q, n = ctypes.c_void_p(self._q.ctypes.data), ctypes.c_void_p(self._n.ctypes.data)
        count, failed = len(self._q), ctypes.byref(self._failed)
        grad = ctypes.c_void_p(self._grad.ctypes.data)
        if kind == "batch":
            H = ctypes.c_void_p(self._H.ctypes.data)
            return float(self._library.time_batch(peer.batch, q, n, count, H, grad, failed))
        if kind == "value":
            return float(self._library.time_value(peer.value, q, n, self._case.robot.nq, count, failed))
        # A warm pass right before: another peer's code has just filled the caches.
        self._library.time_eval(peer.eval, q, n, self._case.robot.nq, 16, grad, failed)
        return float(self._library.time_eval(peer.eval, q, n, self._case.robot.nq, count, grad, failed))
