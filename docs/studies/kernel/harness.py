"""Check kernels (implementations of H and ∇H) against Pinocchio, then measure their times with C loops."""

from __future__ import annotations

import ctypes
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin

from docs.studies.build import Built, build
from docs.studies.core import Vector, one_core
from docs.studies.kernel.counts import Operations
from impact_posture.errors import CompilerError
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact, PointOnLink, point_on
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.system.toolchain import find_compiler

COUNT = 256
# Number of configurations for finite differences.  Few configurations are enough, because each needs many calls of H.
FEW = 16
STEP = 1e-5
# Number of rounds at the beginning that are not timed.
_UNCOUNTED = 2
Kind = Literal["eval", "value", "batch", "differences"]


class Absent(Exception):
    """Another implementation cannot run on this machine; the message states the reason."""


class Disagreement(Exception):
    """A kernel computes different numbers or fails, so that its time has no meaning."""


def c_compiler() -> list[str]:
    """Return the C compiler of the user.

    Raises:
        CompilerError: No C compiler is installed.
    """
    compiler = find_compiler()
    if compiler is None:
        raise CompilerError("no C compiler found", where="benchmarks", hint="install gcc or clang, or set CC")
    return compiler


@dataclass(frozen=True)
class Samples:
    """Robot without supports, its contact frame, and a configuration and a normal for each call."""

    robot: Robot
    frame: str

    @cached_property
    def drawn(self) -> tuple[Vector, Vector]:
        """Configurations, shape (COUNT, nq), and world unit normals, shape (COUNT, 3); the same on every run."""
        rng, robot = np.random.default_rng(0), self.robot
        # The base has random positions and orientations; each joint is at most 1 rad (m) from the default posture.
        width = np.full(robot.nv, 1.0)
        width[: robot.first_joint] = np.pi / 2
        start = robot.posture()
        q = np.array([pin.integrate(robot.model, start, rng.uniform(-width, width)) for _ in range(COUNT)])
        n = rng.normal(size=(COUNT, 3))
        return q, n / np.linalg.norm(n, axis=1, keepdims=True)

    @cached_property
    def moved(self) -> Vector:
        """For the first configurations: ``q`` and ``q ⊕ ±h e_i``, shape (FEW, 1 + 2 nv, nq)."""
        nv, model = self.robot.nv, self.robot.model
        steps = np.concatenate([np.zeros((1, nv)), *[STEP * np.stack([e, -e]) for e in np.eye(nv)]])
        return np.array([[pin.integrate(model, q, step) for step in steps] for q in self.drawn[0][:FEW]])

    @cached_property
    def objective(self) -> WorstCaseObjective:
        """Objective for the export, with W = I."""
        return WorstCaseObjective(self.robot, ImpactContact(self.frame, (0.0, 0.0, 1.0)))

    @cached_property
    def reference(self) -> tuple[Vector, Vector]:
        """H and ∇H by dense linear algebra with Pinocchio, which shares no code with the kernels."""
        pairs = []
        for q, (x, y, z) in zip(*self.drawn, strict=True):
            oracle = ImpactOracle(ImpactCase(self.robot, ImpactContact(self.frame, (float(x), float(y), float(z)))))
            pairs.append((oracle.quantities(q).H, oracle.gradient_H(q)))
        return np.array([H for H, _ in pairs]), np.array([gradient for _, gradient in pairs])

    @property
    def point(self) -> PointOnLink:
        """Contact point, relative to its link."""
        return point_on(self.robot, self.frame)

    @property
    def plain(self) -> bool:
        """Whether every joint, except a free-flyer at the root, has one entry in ``q`` and one in ``v``."""
        model, first = self.robot.model, 2 if self.robot.floating else 1
        return all(pair == (1, 1) for pair in zip([*model.nqs][first:], [*model.nvs][first:], strict=True))


@dataclass(frozen=True)
class Kernel:
    """Implementation of H and ∇H.

    ``functions`` contains the address of a C function for each kind.  ``eval`` is ``int f(q, n, H, grad)``, ``value``
    and ``differences`` are ``int f(q, n, H)``, ``batch`` is ``int f(q, n, count, H, grad)``.
    """

    name: str
    group: str
    built: Built
    functions: dict[Kind, ctypes.c_void_p]
    operations: Operations | None = None  # operations of H and ∇H; None if a template library computes them
    packed: int | None = None  # same, each vector instruction counted once; None without vectors
    source_kb: float | None = None


class Harness:
    """Loops of ``harness.c`` over the samples of a robot."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        text = Path(__file__).with_name("harness.c").read_text(encoding="utf-8")
        self._loop = build({"harness.c": text}, c_compiler(), ["-std=c99", "-O2"]).library.time_pass
        self._loop.restype = ctypes.c_double
        # Buffers for H and ∇H.
        self._results = np.zeros(COUNT), np.zeros((COUNT, samples.robot.nv))

    def pass_s(self, kind: Kind, function: ctypes.c_void_p) -> float:
        """Return the processor time of a pass divided by the number of configurations, s.

        An untimed pass runs first, because other kernels have changed the processor caches.

        Raises:
            Disagreement: A call returned an error code.
        """
        robot, (q, n) = self.samples.robot, self.samples.drawn
        at, count = (self.samples.moved, FEW) if kind == "differences" else (q, COUNT)
        sizes, failed = (robot.nq, robot.nv, count, ctypes.c_double(STEP)), ctypes.c_int(0)
        inputs, outputs = ([ctypes.c_void_p(a.ctypes.data) for a in some] for some in ((at, n), self._results))
        letter = ctypes.c_char(kind[0].encode())
        for _ in range(2):
            took = self._loop(letter, function, *inputs, *sizes, *outputs, ctypes.byref(failed))
        if failed.value:
            raise Disagreement("calls returned an error code")
        return float(took)

    def difference(self, kernel: Kernel) -> float:
        """Return the largest relative difference of H and ∇H (over its largest entry) from the oracle.

        Raises:
            Disagreement: The difference is above 1e-6 (1e-5 for finite differences), or a call returned an error
                code.
        """
        worst = 0.0
        for kind, function in kernel.functions.items():
            for result in self._results:
                result[:] = np.nan
            self.pass_s(kind, function)
            few = FEW if kind == "differences" else COUNT
            (H, gradient), (own_H, own) = (
                (a[:few] for a in some) for some in (self.samples.reference, self._results)
            )
            errors = [worst, np.abs(own_H / H - 1).max()]
            if kind != "value":
                scale = np.maximum(np.abs(gradient).max(axis=1), 1e-3 * np.abs(H))
                errors.append((np.abs(own - gradient).max(axis=1) / scale).max())
            # np.max returns NaN if an entry is NaN, but the built-in max may ignore NaN.
            worst = float(np.max(errors))
        # The condition is not written with ">", because a comparison with NaN is false.
        if not worst <= (1e-5 if kernel.group == "differences" else 1e-6):
            raise Disagreement(f"its numbers differ from Pinocchio's by {worst:.1e}, relative")
        return worst

    def times(self, kernels: Sequence[Kernel], rounds: int) -> list[dict[Kind, float]]:
        """Return the time for each configuration, µs: medians over rounds in which the kernels take turns."""
        passes: list[dict[Kind, list[float]]] = [{kind: [] for kind in kernel.functions} for kernel in kernels]
        with one_core():
            for _ in range(rounds + _UNCOUNTED):
                for kernel, own in zip(kernels, passes, strict=True):
                    for kind, function in kernel.functions.items():
                        own[kind].append(self.pass_s(kind, function))
        return [{kind: statistics.median(t[_UNCOUNTED:]) * 1e6 for kind, t in own.items()} for own in passes]
