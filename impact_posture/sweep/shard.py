"""Solve a shard, a block of grid points, in two passes.  Each pass returns the content of a Parquet file."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from impact_posture.impact.evaluation.velocity_jump import normal_jump
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.sweep.case_solver import CaseSolver, kept
from impact_posture.sweep.point_search import Place, PointResult, Start, Walk, improve, search
from impact_posture.sweep.shard_table import STATUS, read_shard, write_shard
from impact_posture.sweep.sweep_file import Sweep
from impact_posture.system.arrays import Array

# A worker process with several threads solves one shard at a time, because MUMPS, the linear solver in IPOPT, is not
# thread-safe.
_ALONE = threading.Lock()
# Number of cases (:class:`Case`) whose robots and programs stay in the memory of a worker.
_KEPT = 4
_KEPT_WALKS = 64
_SOLVERS: OrderedDict[tuple[str, int], CaseSolver] = OrderedDict()


@dataclass(frozen=True)
class ShardResult:
    """Result of one pass over a shard.

    Attributes:
        index: Number of the shard.
        content: Content of the Parquet file.
        counts: Number of points of each status.
        solver_s: Wall time in IPOPT, s.
        total_s: Wall time of the whole pass, s.
    """

    index: int
    content: bytes
    counts: Mapping[str, int]
    solver_s: float
    total_s: float


def solve_shard(sweep: Sweep, key: str, index: int) -> ShardResult:
    """First pass: solve all points of shard ``index``, starting each point from the postures of earlier neighbors.

    ``key`` is the hash that identifies the sweep (:func:`sweep_key`).
    """
    return _passed(sweep, key, index, 1, [], _Shard.solve)


def revise_shard(
    sweep: Sweep, key: str, index: int, content: bytes, beside: Mapping[int, list[float]]
) -> ShardResult:
    """Second pass: improve the points of a shard, starting from the postures of neighboring points.

    ``content`` is the shard file that the first pass (:func:`solve_shard`) wrote.  ``beside`` maps the neighboring
    points in other shards to their postures after the first pass.
    """
    return _passed(sweep, key, index, 2, read_shard(content), lambda shard: shard.revise(beside))


def _passed(
    sweep: Sweep, key: str, index: int, passes: int, known: list[PointResult], work: Callable[[_Shard], None]
) -> ShardResult:
    with _ALONE, one_blas_thread():
        began = time.perf_counter()
        case, points = sweep.span(index)
        speeds = max((len(axis.values) for axis in sweep.grid.axes if axis.name == "speed"), default=1)
        solver = kept(_SOLVERS, (key, case), lambda: CaseSolver(sweep.cases[case], speeds), _KEPT)
        solver.timer.solver_s = 0.0
        shard = _Shard(sweep, solver, points, known)
        work(shard)
        content = write_shard(sweep, key, index, passes, shard.results, shard.predicted)
        counts = {status: sum(point.row["status"] == status for point in shard.results) for status in STATUS}
        return ShardResult(index, content, counts, solver.timer.solver_s, time.perf_counter() - began)


class _Shard:
    """Points of a shard.  ``results`` contains the results of the points that are already solved."""

    def __init__(self, sweep: Sweep, solver: CaseSolver, points: range, results: list[PointResult]) -> None:
        self._grid, self._solver, self._points, self.results = sweep.grid, solver, points, results
        self._walks: OrderedDict[int, Walk] = OrderedDict()

    def solve(self) -> None:
        """Solve each point from its earlier neighbors, then improve it from its later neighbors."""
        grid, first = self._grid, self._points.start
        for point, is_new in self._problems():
            if not is_new:
                self.results.append(self.results[-1])
                continue
            before = [self.results[k - first] for k in grid.neighbors(point, first)]
            guesses = [result.start for result in before if result.start is not None]
            violations = [result.violation for result in before if result.violation]
            beside = 0.0 if guesses else min(violations, default=0.0)
            self.results.append(search(*self._at(point), guesses, beside))
        # From the optimum of a later grid point, the solver may reach a better optimum at earlier grid points.
        for point in reversed(self._points):
            start = self.results[point - first].start
            if start is not None:
                for other in grid.neighbors(point, first):
                    self._improve(other, start)
        self._share()

    def revise(self, beside: Mapping[int, list[float]]) -> None:
        """Improve border points from postures in other shards, then interior points from improved neighbors."""
        improved = set[int]()

        def improve_from_neighbors(points: Iterable[int], starts: Callable[[int], Start | None]) -> None:
            for point in points:
                for other in self._grid.around(point):
                    start = starts(other)
                    if start is not None and self._improve(point, start):
                        improved.add(point)

        def here(other: int) -> Start | None:
            return self.results[other - self._points.start].start if other in improved else None

        def anywhere(other: int) -> Start | None:
            if other in self._points:
                return here(other)
            return Start(np.array(beside[other])) if other in beside else None

        points = [point for point, is_new in self._problems() if is_new]
        improve_from_neighbors(points, anywhere)
        improve_from_neighbors(reversed(points), here)
        self._share()

    def predicted(self, values: Mapping[str, Any], q: Array, row: Mapping[str, Any]) -> dict[str, float | None]:
        """Return the predicted impulse, predicted jump and attainable speed of a grid point."""
        choice = self._solver.normal_and_speed(values)
        impact = self._solver.template(*choice).impact
        approach = normal_jump(impact.speed, impact.restitution)
        return {
            "predicted_impulse": approach / row["G"],
            "predicted_jump": approach * row["V"] ** 0.5,
            "attainable_speed": self._solver.attainable(*choice).reached(q),
        }

    def _at(self, point: int) -> tuple[Walk, Place]:
        values = self._grid.values(point)
        prepared = self._solver.template(*self._solver.normal_and_speed(values))
        walk = kept(self._walks, id(prepared.problem), partial(self._solver.walk, prepared.problem), _KEPT_WALKS)
        return walk, self._solver.target(values)

    def _problems(self) -> Iterator[tuple[int, bool]]:
        """Yield each point, and whether its problem differs from the problem of the previous point.

        Points that differ only in the speed have the same problem, unless a requirement depends on the speed.
        """
        last: tuple[Walk, Place] | None = None
        for point in self._points:
            walk, place = self._at(point)
            yield point, last is None or last[0] is not walk or last[1] != place
            last = walk, place

    def _improve(self, point: int, start: Start) -> bool:
        """Solve a grid point from the posture of a neighbor; return whether its result improved."""
        index = point - self._points.start
        known = self.results[index]
        self.results[index] = improve(*self._at(point), known, start)
        return self.results[index] is not known

    def _share(self) -> None:
        """Copy the result of a grid point to the next grid points if they have the same problem."""
        # Copy from the first point with the same problem, because this point was solved from the largest number of
        # neighbors.
        for point, is_new in self._problems():
            if not is_new:
                index = point - self._points.start
                self.results[index] = self.results[index - 1]
