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

from impact_posture.arrays import Array
from impact_posture.posture.nlp import one_blas_thread
from impact_posture.sweep.case_solver import CaseSolver, PointResult, Walk, kept
from impact_posture.sweep.grid import Axis
from impact_posture.sweep.sweep_file import Sweep

# MUMPS, within IPOPT, is not made for threads; a worker with several takes its shards one after the other.
_ALONE = threading.Lock()
# Cases whose robots and programs a worker keeps.
_KEPT = 4
# Problems of a shard that may have grown.
_KEPT_WALKS = 64
_SOLVERS: OrderedDict[tuple[str, int], CaseSolver] = OrderedDict()

STATUS = ("certified", "infeasible", "uncertified", "undefined")


@dataclass(frozen=True)
class ShardResult:
    """A finished shard.

    Attributes:
        index: Index of the shard.
        content: Its Parquet file.
        counts: Number of points of each status.
        solver_s: Processor time within IPOPT, s.
        total_s: Processor time of the shard, s.
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
        began = time.process_time()
        case, points = sweep.span(index)
        solver = _solver(sweep, key, case)
        solver.solver_s = 0.0
        results = _walk(sweep, solver, points)
        content = _parquet(sweep, key, case, points, results, solver)
        counts = {status: sum(one.status == status for one in results) for status in STATUS}
        return ShardResult(index, content, counts, solver.solver_s, time.process_time() - began)


def _solver(sweep: Sweep, key: str, case: int) -> CaseSolver:
    return kept(_SOLVERS, (key, case), lambda: CaseSolver(sweep.cases[case]), _KEPT)


def _walk(sweep: Sweep, solver: CaseSolver, points: range) -> list[PointResult]:
    results: list[PointResult] = []
    walks: OrderedDict[int, Walk] = OrderedDict()
    last: tuple[Walk | None, Any] = None, None
    for point in points:
        values = sweep.grid.values(point)
        prepared = solver.template(*solver.normal_and_speed(values))
        walk = kept(walks, id(prepared.problem), partial(Walk, solver, prepared.problem), _KEPT_WALKS)
        target = solver.target(prepared, values)
        if last[0] is walk and last[1] == target:
            # Only the speed differs, and the problem does not see it.
            results.append(results[-1])
            continue
        before = [results[k - points.start].q for k in sweep.grid.neighbors(point, points.start)]
        results.append(solver.search(walk, target, [q for q in before if q is not None]))
        last = walk, target
    return results


def _parquet(
    sweep: Sweep, key: str, case: int, points: range, results: Sequence[PointResult], solver: CaseSolver
) -> bytes:
    """Return the table of a shard as a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    numbers = pa.float64()
    columns: dict[str, Any] = {"point": pa.array([case * sweep.grid.size + k for k in points], pa.int64())}
    places = [sweep.grid.values(k) for k in points]
    for axis in (*sweep.outer, *sweep.grid.axes):
        kind, plain = _kind(axis)
        at = [(values | sweep.cases[case].values)[axis.name] for values in places]
        columns[axis.name] = pa.array(at if plain else [json.dumps(value) for value in at], kind)
    for name in ("status", "reason"):
        columns[name] = pa.array([getattr(one, name) for one in results], pa.string())
    columns["q"] = pa.array([_list(one.q) for one in results], pa.list_(numbers))
    columns["objective"] = pa.array([one.objective for one in results], numbers)
    for name in "HGVSE":
        columns[name] = pa.array([one.quantities.get(name) for one in results], numbers)
    impacts = [solver.template(*solver.normal_and_speed(values)).impact for values in places]
    approach = [(1 + impact.restitution) * impact.speed for impact in impacts]
    pairs = list(zip(results, approach, strict=True))
    columns["impulse"] = pa.array([v / one.quantities["G"] if one.q is not None else None for one, v in pairs], numbers)
    columns["jump"] = pa.array([v * one.quantities["V"] ** 0.5 if one.q is not None else None for one, v in pairs], numbers)
    for name, kind in (("stationarity", numbers), ("violation", numbers), ("optima", pa.int32()), ("runs", pa.int32())):
        columns[name] = pa.array([getattr(one, name) for one in results], kind)
    table = pa.table(columns).replace_schema_metadata({"sweep": key})
    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd")
    return bytes(sink.getvalue())


def _kind(axis: Axis) -> tuple[Any, bool]:
    """Return the Arrow type of the column of an axis, and whether it holds the values as they are, not as JSON."""
    import pyarrow as pa

    for kind, python in ((pa.bool_(), (bool,)), (pa.float64(), (int, float)), (pa.string(), (str,))):
        if all(isinstance(value, python) and (bool in python or value is not True) for value in axis.values):
            return kind, True
    vectors = all(isinstance(v, list | tuple) and all(isinstance(x, float | int) for x in v) for v in axis.values)
    return (pa.list_(pa.float64()), True) if vectors else (pa.string(), False)


def _list(q: Array | None) -> list[float] | None:
    return None if q is None else q.tolist()
