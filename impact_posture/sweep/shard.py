"""Solve a shard: what a worker gets, and the Parquet file that it returns."""

from __future__ import annotations

import json
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from impact_posture.posture.nlp import one_blas_thread
from impact_posture.sweep.case_solver import CaseSolver, kept
from impact_posture.sweep.grid import Axis
from impact_posture.sweep.point_search import PointResult, Walk, improve, search
from impact_posture.sweep.sweep_file import Sweep

# MUMPS, within IPOPT, is not made for threads; a worker with several takes its shards one after the other.
_ALONE = threading.Lock()
# Cases whose robots and programs a worker keeps.
_KEPT = 4
# Problems of a shard that may have grown.
_KEPT_WALKS = 64
_SOLVERS: OrderedDict[tuple[str, int], CaseSolver] = OrderedDict()

STATUS = ("certified", "infeasible", "uncertified", "undefined")
NUMBERS = ("value", *"HGVSE", "predicted_impulse", "predicted_jump", "stationarity", "violation")


@dataclass(frozen=True)
class ShardResult:
    """A finished shard.

    Attributes:
        index: Index of the shard.
        content: Its Parquet file.
        counts: Number of points of each status.
        solver_s: Wall time within IPOPT and the functions that it calls, s.
        total_s: Wall time of the shard, s.
    """

    index: int
    content: bytes
    counts: Mapping[str, int]
    solver_s: float
    total_s: float


def solve_shard(sweep: Sweep, key: str, index: int) -> ShardResult:
    """Solve all points of a shard, each from its fixed predecessors.

    Args:
        sweep: The sweep.
        key: Hash of the sweep, its robots and this version.
        index: Index of the shard.

    Raises:
        ImpactPostureError: A setting is wrong.
    """
    with _ALONE, one_blas_thread():
        began = time.perf_counter()
        case, points = sweep.span(index)
        solver = _solver(sweep, key, case)
        solver.timer.solver_s = 0.0
        results = _walk(sweep, solver, points)
        content = _parquet(sweep, key, case, points, results, solver)
        counts = {status: sum(one.row["status"] == status for one in results) for status in STATUS}
        return ShardResult(index, content, counts, solver.timer.solver_s, time.perf_counter() - began)


def _solver(sweep: Sweep, key: str, case: int) -> CaseSolver:
    speeds = max((len(axis.values) for axis in sweep.grid.axes if axis.name == "speed"), default=1)
    return kept(_SOLVERS, (key, case), lambda: CaseSolver(sweep.cases[case], speeds), _KEPT)


def _walk(sweep: Sweep, solver: CaseSolver, points: range) -> list[PointResult]:
    """Solve the points of a shard, each from the neighbors before it, then look back from the neighbors after it."""
    results: list[PointResult] = []
    walks: OrderedDict[int, Walk] = OrderedDict()
    # Points that are the same problem as the one before them, and have its answer.
    alike: list[int] = []

    def at(point: int) -> tuple[Walk, Any]:
        values = sweep.grid.values(point)
        prepared = solver.template(*solver.normal_and_speed(values))
        walk = kept(walks, id(prepared.problem), partial(solver.walk, prepared.problem), _KEPT_WALKS)
        return walk, solver.target(values)

    last: tuple[Walk, Any] | None = None
    for point in points:
        walk, target = at(point)
        if last is not None and last[0] is walk and last[1] == target:
            # Only the speed differs, and the problem does not see it.
            results.append(results[-1])
            alike.append(point)
            continue
        before = [results[k - points.start] for k in sweep.grid.neighbors(point, points.start)]
        guesses = [one.q for one in before if one.q is not None]
        beside = 0.0 if guesses else min((one.violation for one in before if one.violation), default=0.0)
        results.append(search(walk, target, guesses, beside))
        last = walk, target
    # An optimum that appears on the way may have been the better one already before.
    for point in reversed(points):
        posture = results[point - points.start].q
        if posture is not None:
            for other in sweep.grid.neighbors(point, points.start):
                known = results[other - points.start]
                results[other - points.start] = improve(*at(other), known, posture)
    # The first speed has the most neighbors of its own.
    for point in alike:
        results[point - points.start] = results[point - points.start - 1]
    return results


def _parquet(
    sweep: Sweep, key: str, case: int, points: range, results: Sequence[PointResult], solver: CaseSolver
) -> bytes:
    """Return the table of a shard as a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    axes = (*sweep.outer, *sweep.grid.axes)
    kinds = {axis.name: _kind(axis) for axis in axes}
    number, text, count = pa.float64(), pa.string(), pa.int32()
    own = [("status", text), ("reason", text), ("q", pa.list_(number)), *[(name, number) for name in NUMBERS]]
    columns = [("point", pa.int64()), *kinds.items(), *own, ("optima", count), ("runs", count)]
    rows = []
    for point, result in zip(points, results, strict=True):
        values = {**sweep.grid.values(point), **sweep.cases[case].values}
        # A value that Arrow has no plain type for is JSON.
        odd = {name: json.dumps(v) for name, v in values.items() if kinds[name] == text and not isinstance(v, str)}
        rows.append({"point": case * sweep.grid.size + point, **values, **odd, **result.row})
        if result.q is not None:
            impact = solver.template(*solver.normal_and_speed(values)).impact
            approach = (1 + impact.restitution) * impact.speed
            rows[-1] |= {
                "predicted_impulse": approach / result.row["G"],
                "predicted_jump": approach * result.row["V"] ** 0.5,
            }
    table = pa.Table.from_pylist(rows, pa.schema(columns, metadata={"sweep": key}))
    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd")
    return bytes(sink.getvalue())


def _kind(axis: Axis) -> Any:
    """Return the Arrow type of the column of an axis."""
    import pyarrow as pa

    if all(isinstance(value, bool) for value in axis.values):
        return pa.bool_()
    if all(isinstance(value, int | float) for value in axis.values):
        return pa.float64()
    vectors = all(isinstance(v, list | tuple) and all(isinstance(x, float | int) for x in v) for v in axis.values)
    return pa.list_(pa.float64()) if vectors else pa.string()
