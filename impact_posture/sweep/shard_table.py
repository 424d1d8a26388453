"""Table of a shard: a Parquet file with one row per point."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from impact_posture.sweep.point_search import PointResult, Start
from impact_posture.sweep.sweep_file import Axis, Sweep
from impact_posture.system.arrays import Array
from impact_posture.system.sealed_files import UNSEALED, is_intact, sealed

STATUS = ("certified", "infeasible", "uncertified", "undefined")
PREDICTED = ("predicted_impulse", "predicted_jump", "attainable_speed")
NUMBERS = ("value", *"HGVSE", *PREDICTED, "stationarity", "violation")


def write_shard(
    sweep: Sweep,
    key: str,
    index: int,
    passes: int,
    results: Sequence[PointResult],
    predicted: Callable[[Mapping[str, Any], Array, Mapping[str, Any]], dict[str, float | None]],
) -> bytes:
    """Return the content of the Parquet file of a shard after ``passes`` passes, with checksums.

    ``predicted`` computes the columns :data:`PREDICTED` of a point from its grid values, posture and other columns.
    """
    import pyarrow as pa
    from pyarrow import parquet

    case, points = sweep.span(index)
    axes = (*sweep.outer, *sweep.grid.axes)
    kinds = {axis.name: _kind(axis) for axis in axes}
    number, text, count = pa.float64(), pa.string(), pa.int32()
    outputs = [("status", text), ("reason", text), ("q", pa.list_(number)), *[(name, number) for name in NUMBERS]]
    columns = [("point", pa.int64()), *kinds.items(), *outputs, ("optima", count), ("runs", count)]
    rows = []
    for point, result in zip(points, results, strict=True):
        values = {**sweep.grid.values(point), **sweep.cases[case].values}
        # Values that have no simple Arrow type are stored as JSON text.
        odd = {name: json.dumps(v) for name, v in values.items() if kinds[name] == text and not isinstance(v, str)}
        rows.append({"point": case * sweep.grid.size + point, **values, **odd, **result.row})
        if result.q is not None:
            rows[-1] |= predicted(values, result.q, result.row)
    identity = {"sweep": key, "shard": shard_name(sweep, index), "passes": str(passes), "checksum": UNSEALED}
    table = pa.Table.from_pylist(rows, pa.schema(columns, metadata=identity))
    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink, compression="zstd", write_page_checksum=True)
    return sealed(bytes(sink.getvalue()))


def shard_name(sweep: Sweep, index: int) -> str:
    """Return the path of a shard file below the folder of all shards."""
    case, part = divmod(index, sweep.shards_of_case)
    return f"case={case}/shard-{part:06d}.parquet"


def read_shard(content: bytes) -> list[PointResult]:
    """Return the results of all points, read from the content of a shard file."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = ["status", "reason", "q", *(name for name in NUMBERS if name not in PREDICTED), "optima", "runs"]
    results = []
    for row in parquet.read_table(pa.BufferReader(content), columns=columns).to_pylist():
        known = {name: value for name, value in row.items() if value is not None}
        results.append(PointResult(known, Start(np.array(known["q"])) if "q" in known else None))
    return results


def read_postures(content: bytes) -> list[list[float] | None]:
    """Return the posture of each point, from the content of a shard file; ``None`` for points without a posture."""
    import pyarrow as pa
    from pyarrow import parquet

    q: list[list[float] | None] = parquet.read_table(pa.BufferReader(content), columns=["q"])["q"].to_pylist()
    return q


def passes_of(content: bytes, key: str, name: str) -> int:
    """Return the number of passes, 1 or 2, after which a shard file was written.

    The result is 0 if the file is damaged, or is not the shard ``name`` of the sweep ``key``.
    """
    sweep, passes = origin_of(content, name)
    return passes if sweep == key else 0


def origin_of(content: bytes, name: str) -> tuple[str, int]:
    """Return the key of the sweep of a shard file, and the number of passes, 1 or 2, after which it was written.

    The result is ``("", 0)`` if the file is damaged, or is not the shard ``name`` of a sweep.
    """
    import pyarrow as pa
    from pyarrow import ArrowException, parquet

    if not is_intact(content):
        return "", 0
    try:
        metadata = parquet.read_metadata(pa.BufferReader(content)).metadata
        if metadata[b"shard"] != name.encode():
            return "", 0
        return metadata[b"sweep"].decode(), int(metadata[b"passes"])
    except (ArrowException, LookupError, TypeError):  # another sealed file, such as the manifest
        return "", 0


def _kind(axis: Axis) -> Any:
    """Return the Arrow type of the column with the values of an axis."""
    import pyarrow as pa

    if all(isinstance(value, bool) for value in axis.values):
        return pa.bool_()
    if all(isinstance(value, int | float) for value in axis.values):
        return pa.float64()
    vectors = all(isinstance(v, list | tuple) and all(isinstance(x, float | int) for x in v) for v in axis.values)
    return pa.list_(pa.float64()) if vectors else pa.string()
