"""Maps of a sweep: objective over two axes, points without posture, and borders between different optima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import parse_toml, validate
from impact_posture.errors import InputError, nearest
from impact_posture.output.plot.style import GRAY, INK, PALE, VERMILLION, framed, save, shared_legend
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import wrapped_difference
from impact_posture.sweep.atlas import open_atlas, reading
from impact_posture.sweep.point_search import SWITCH
from impact_posture.sweep.shard_table import STATUS
from impact_posture.sweep.sweep_file import Axis, Grid
from impact_posture.sweep.sweep_manifest import MANIFEST, read_manifest
from impact_posture.system.arrays import Array
from impact_posture.system.escape import plot_label
from impact_posture.system.output_folder import added_files

# Two neighboring points count as different optima if the difference of their postures exceeds ``SWITCH`` and this
# multiple of the lower quartile of all differences.  The lower quartile estimates the difference between neighbors
# with the same optimum.  The difference of two postures is a norm in the tangent space, without the position of the
# base.
_UNUSUAL = 4.0
# The color scale is logarithmic if the ratio of the largest to the smallest objective exceeds this value.
_WIDE = 20.0
_HATCH = {"infeasible": "////", "uncertified": "....", "undefined": "xxxx"}
# Maximum number of labels along an axis.
_TICKS = 9


@dataclass(frozen=True)
class Shown:
    """Summary of the maps of a sweep.

    Attributes:
        points: Number of grid points of the sweep, each of which is a problem.
        counts: Number of solved points of each status.
        switches: Number of pairs of neighboring points in the maps that have different optima.
        best: Axis values and objective of the best point of each case (:class:`Case`).
        files: Paths of the written figures.
    """

    points: int
    counts: dict[str, int]
    switches: int
    best: list[dict[str, Any]]
    files: list[Path]

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document of ``sweep show``."""
        files = [str(path) for path in self.files]
        return {"schema": "impact-posture/sweep-show/1", **vars(self), "files": files}


def draw_maps(
    folder: Path,
    out: Path,
    axes: Sequence[str] | None = None,
    formats: Sequence[str] = ("png",),
    *,
    force: bool = False,
) -> Shown:
    """Draw a map for each case of a sweep folder and write it into ``out``.  The sweep may be unfinished.

    ``axes`` contains the names of the horizontal and the vertical axis, by default the two axes with the most values.
    The map shows the points at which the other axes have their middle values.  With ``force``, a map replaces a file
    of the user with the same name in ``out``.

    Raises:
        InputError: An axis is unknown.
        OutputError: A file of the user has the name of a map, or ``out`` cannot be written.
        SpecError: The folder is not a sweep folder, or is damaged.
    """
    from pyarrow import compute

    data, manifest = open_atlas(folder), read_manifest(folder)
    grid, where = manifest.grid, str(folder / MANIFEST)
    settings = [validate(ProblemSettings, parse_toml(case.problem, where), where) for case in manifest.cases]
    problems = [prepare(setting).problem for setting in settings]
    across, upwards = _chosen(grid, axes)
    plane = _plane(grid, across, upwards)
    cases, best, files = manifest.cases, list[dict[str, Any]](), list[Path]()
    with reading(folder):
        counts = {status: data.count_rows(filter=compute.field("status") == status) for status in STATUS}
        tables = [_Slice(data, plane + k * grid.size, problem) for k, problem in enumerate(problems)]
        for number, case in enumerate(cases):
            best += _best(data, grid, number, case.values)
    with added_files(out, force=force) as beside:
        for number, (case, problem, table) in enumerate(zip(cases, problems, tables, strict=True)):
            path = beside / f"map-{number}"
            files += _draw(table, grid, (across, upwards), case.values, problem, path, formats)
    switches = sum(len(table.switches) for table in tables)
    return Shown(manifest.points, counts, switches, best, [out / path.name for path in files])


def _chosen(grid: Grid, axes: Sequence[str] | None) -> tuple[int, int | None]:
    """Return the indices of the horizontal and the vertical axis; the latter is ``None`` for a map over one axis."""
    names = [axis.name for axis in grid.axes]
    if axes is None:
        longest = sorted(range(len(names)), key=lambda k: (-grid.shape[k], k))[:2]
        if not longest:
            hint = "read the table with impact_posture.sweep.open"
            raise InputError("has no axis that varies", where="grid", hint=hint)
        return longest[0], longest[1] if len(longest) > 1 and grid.shape[longest[1]] > 1 else None
    for name in axes:
        if name not in names:
            hint = f"did you mean {', '.join(nearest(name, names))}?"
            raise InputError(f"no axis '{name}'", where="axes", hint=hint)
    if not 1 <= len(set(axes)) == len(axes) <= 2:
        raise InputError(f"names {len(axes)} axes", where="axes", hint="give one axis or two different axes")
    return names.index(axes[0]), names.index(axes[1]) if len(axes) > 1 else None


def _plane(grid: Grid, across: int, upwards: int | None) -> NDArray[np.int64]:
    """Return the points of a map, shape (rows, columns); the other axes have their middle values."""
    place: list[Any] = [count // 2 for count in grid.shape]
    place[across] = np.arange(grid.shape[across])
    if upwards is not None:
        place[upwards] = np.arange(grid.shape[upwards])[:, None]
    return np.atleast_2d(np.ravel_multi_index(tuple(place), grid.shape))


class _Slice:
    """Points of one map.

    Attributes:
        status: Status of each point, empty if the point is not solved, shape (rows, columns).
        value: Objective of each point, NaN if the point has no posture, shape (rows, columns).
        switches: Pairs of neighbors ``(row, column), (row, column)`` that have different optima.
    """

    def __init__(self, data: Any, points: NDArray[np.int64], problem: ConstrainedProblem) -> None:
        from pyarrow import compute

        wanted = compute.field("point").isin(points.ravel().tolist())
        rows = data.to_table(columns=["point", "status", "value", "q"], filter=wanted).to_pylist()
        known = {row["point"]: row for row in rows}
        none = {"status": "", "value": None, "q": None}
        at = [[known.get(int(point), none) for point in line] for line in points]
        self.status = np.array([[row["status"] for row in line] for line in at])
        self.value = np.array([[row["value"] for row in line] for line in at], dtype=float)
        postures = [[row["q"] and np.array(row["q"]) for row in line] for line in at]
        self.switches = _switches(postures, problem)


def _switches(postures: Sequence[Sequence[Array | None]], problem: ConstrainedProblem) -> list[tuple[Any, Any]]:
    steps = []
    # The base of a floating robot moves with the target, so the position of the base is not compared.
    first = 3 if problem.robot.floating else 0
    for row, line in enumerate(postures):
        for column, q in enumerate(line):
            for other in ((row, column + 1), (row + 1, column)):
                if other[0] < len(postures) and other[1] < len(line) and q is not None:
                    next_to = postures[other[0]][other[1]]
                    if next_to is not None:
                        size = float(np.linalg.norm(wrapped_difference(problem, q, next_to)[first:]))
                        steps.append((size, (row, column), other))
    usual = float(np.quantile([size for size, _, _ in steps], 0.25)) if steps else 0.0
    return [(cell, other) for size, cell, other in steps if size > max(SWITCH, _UNUSUAL * usual)]


def _best(data: Any, grid: Grid, number: int, values: dict[str, Any]) -> list[dict[str, Any]]:
    from pyarrow import compute

    least = (np.inf, -1)
    in_case = (compute.field("case") == number) & (compute.field("status") == "certified")
    for batch in data.to_batches(columns=["point", "value"], filter=in_case):
        if batch.num_rows:
            objective = batch["value"].to_numpy()
            k = int(objective.argmin())
            least = min(least, (float(objective[k]), int(batch["point"][k].as_py())))
    if least[1] < 0:
        return []
    point = least[1] - number * grid.size
    return [{**values, **grid.values(point), "value": float(f"{least[0]:.6g}"), "point": least[1]}]


def _draw(
    table: _Slice,
    grid: Grid,
    axes: tuple[int, int | None],
    values: dict[str, Any],
    problem: ConstrainedProblem,
    path: Path,
    formats: Sequence[str],
) -> list[Path]:
    across, upwards = axes
    rows, columns = table.value.shape
    others = [f"{a.name} {a.values[len(a.values) // 2]}" for k, a in enumerate(grid.axes) if k not in axes]
    contacts = ", ".join(contact.frame for contact in problem.objective.contacts)
    units = getattr(problem.objective, "units", "its own units")
    what = [f"{problem.robot.name} at {contacts}", f"objective in {units}"]
    facts = " · ".join(what + [f"{key} {value}" for key, value in values.items()] + others)
    notes = [f"{len(table.switches)} steps between neighbors switch to another optimum."]
    missing = int((table.status == "").sum())
    if missing:
        notes.append(f"{missing} points are not solved yet.")
    with framed("Objective of the best posture", [facts], 1.4 + min(3.4, 0.45 * rows), notes) as (figure, body):
        panel = body.subplots()
        known = table.value[np.isfinite(table.value)]
        wide = known.size > 0 and known.min() > 0 and known.max() > _WIDE * known.min()
        edges = np.arange(columns + 1) - 0.5, np.arange(rows + 1) - 0.5
        drawn = panel.pcolormesh(*edges, np.ma.masked_invalid(table.value), norm=LogNorm() if wide else None)
        if known.size:
            body.colorbar(drawn, ax=panel, label="objective")
        handles: list[Any] = []
        for status, hatch in _HATCH.items():
            cells = np.argwhere(table.status == status)
            for row, column in cells:
                cell = Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=PALE, edgecolor=GRAY, hatch=hatch)
                panel.add_patch(cell).set_linewidth(0)
            if len(cells):
                handles.append(Patch(facecolor=PALE, edgecolor=GRAY, hatch=hatch, label=status))
        if table.switches:
            lines = [_edge(*pair) for pair in table.switches]
            panel.add_collection(LineCollection(lines, colors=VERMILLION, linewidths=1.8))
            handles.append(Line2D([], [], color=VERMILLION, linewidth=1.8, label="switch to another optimum"))
        if known.size:
            row, column = np.unravel_index(np.nanargmin(table.value), table.value.shape)
            handles += panel.plot(
                column, row, marker="*", markersize=9, color="white", markeredgecolor=INK, linestyle="none",
                label="least objective",
            )  # fmt: skip
        _label(panel.xaxis, grid.axes[across])
        if upwards is None:
            panel.set_yticks([])
        else:
            _label(panel.yaxis, grid.axes[upwards])
        if handles:
            shared_legend(body, handles, "lower")
        return save(figure, path.parent, path.name, formats)


def _edge(cell: tuple[int, int], other: tuple[int, int]) -> list[tuple[float, float]]:
    """Return the two end points of the border between two neighboring cells."""
    row, column = (np.array(cell) + np.array(other)) / 2
    if cell[0] == other[0]:
        return [(column, row - 0.5), (column, row + 0.5)]
    return [(column - 0.5, row), (column + 0.5, row)]


def _label(axis: Any, grid_axis: Axis) -> None:
    count = len(grid_axis.values)
    shown = np.unique(np.linspace(0, count - 1, min(count, _TICKS)).round().astype(int))
    # On the horizontal axis, long labels would overlap, so the entries of a vector are written below each other.
    space = "\n" if axis.axis_name == "x" and isinstance(grid_axis.values[0], tuple) else " "
    axis.set_ticks(shown, [plot_label(_short(grid_axis.values[k])).replace(" ", space) for k in shown])
    axis.set_label_text(plot_label(grid_axis.name + (" offset, m" if grid_axis.name in "xyz" else "")))


def _short(value: Any) -> str:
    values = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in values)
