"""Maps of a sweep: the objective over two axes, where no posture exists, and where the best one switches."""

from __future__ import annotations

import tomllib
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

from impact_posture.config.settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.errors import InputError, SpecError, nearest
from impact_posture.output.plot.style import GRAY, INK, PALE, VERMILLION, framed, save, shared_legend
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import wrapped_difference
from impact_posture.sweep.atlas import open_atlas, read_manifest
from impact_posture.sweep.point_search import SWITCH
from impact_posture.sweep.shard_table import STATUS
from impact_posture.sweep.sweep_file import Axis, Grid
from impact_posture.system.arrays import Array
from impact_posture.system.escape import plot_label

# The best posture switches between neighbors that differ (tangent norm, without the place of the base) by more than
# SWITCH, and by more than this many times what the closest quarter of all neighbors differ by at most: half of them
# may be on both sides of a switch.
_UNUSUAL = 4.0
# From this ratio of the largest to the least objective on, colors follow its logarithm.
_WIDE = 20.0
_HATCH = {"infeasible": "////", "uncertified": "....", "undefined": "xxxx"}
# Most labels of values along an axis.
_TICKS = 9


@dataclass(frozen=True)
class Shown:
    """What the maps of a sweep show.

    Attributes:
        points: Number of problems of the sweep.
        counts: Number of solved points of each status.
        switches: Number of steps between neighbors of the maps at which the best posture switches.
        best: The point with the least objective of each case: its values and its objective.
        files: The pictures.
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


def draw_maps(folder: Path, out: Path, axes: Sequence[str] | None = None, formats: Sequence[str] = ("png",)) -> Shown:
    """Draw a map of each case of a sweep folder.

    All other axes are at their middle value.

    Args:
        folder: The sweep folder, finished or not.
        out: Folder of the pictures.
        axes: Names of the axes across and upwards; by default the two with the most values.
        formats: Formats of the pictures.

    Raises:
        InputError: There is no such axis.
        SpecError: The folder is none of a sweep.
    """
    from pyarrow import compute

    data, manifest = open_atlas(folder), read_manifest(folder)
    try:
        grid = Grid(tuple(Axis(axis["name"], tuple(map(_hashable, axis["values"]))) for axis in manifest["axes"]))
        cases, points = manifest["cases"], int(manifest["points"])
        problems = [
            prepare(validate(ProblemSettings, tomllib.loads(c["problem"]), str(folder))).problem for c in cases
        ]
    except (LookupError, TypeError, ValueError) as error:
        raise SpecError(
            f"is damaged ({error})", where=str(folder / "manifest.json"), hint="run sweep again"
        ) from None
    across, upwards = _chosen(grid, axes)
    plane = _plane(grid, across, upwards)
    counts = {one: data.count_rows(filter=compute.field("status") == one) for one in STATUS}
    switches, best, files = 0, list[dict[str, Any]](), list[Path]()
    for number, (case, problem) in enumerate(zip(cases, problems, strict=True)):
        table = _Slice(data, plane + number * grid.size, problem)
        switches += len(table.switches)
        best += _best(data, grid, number, case["values"])
        files += _draw(table, grid, (across, upwards), case["values"], problem, out / f"map-{number}", formats)
    return Shown(points, counts, switches, best, files)


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _chosen(grid: Grid, asked: Sequence[str] | None) -> tuple[int, int | None]:
    """Return the indices of the axes across and upwards; ``None`` if there is only one."""
    names = [axis.name for axis in grid.axes]
    if asked is None:
        longest = sorted(range(len(names)), key=lambda k: (-grid.shape[k], k))[:2]
        if not longest:
            raise InputError(
                "has no axis that varies", where="grid", hint="read the table with impact_posture.sweep.open"
            )
        return longest[0], longest[1] if len(longest) > 1 and grid.shape[longest[1]] > 1 else None
    for name in asked:
        if name not in names:
            hint = f"did you mean {', '.join(nearest(name, names))}?"
            raise InputError(f"no axis '{name}'", where="axes", hint=hint)
    if not 1 <= len(set(asked)) == len(asked) <= 2:
        raise InputError(f"names {len(asked)} axes", where="axes", hint="give one or two different ones")
    return names.index(asked[0]), names.index(asked[1]) if len(asked) > 1 else None


def _plane(grid: Grid, across: int, upwards: int | None) -> NDArray[np.int64]:
    """Return the points of a map, shape (rows, columns); other axes are at their middle value."""
    place: list[Any] = [count // 2 for count in grid.shape]
    place[across] = np.arange(grid.shape[across])
    if upwards is not None:
        place[upwards] = np.arange(grid.shape[upwards])[:, None]
    return np.atleast_2d(np.ravel_multi_index(tuple(place), grid.shape))


class _Slice:
    """The points of one map.

    Args:
        data: The table of the sweep.
        points: The points of the map, shape (rows, columns).
        problem: The problem of the case.

    Attributes:
        status: Status of each point; empty where none is solved yet, shape (rows, columns).
        value: Objectives, NaN where there is none, shape (rows, columns).
        switches: Pairs of neighbors ``(row, column), (row, column)`` between which the best posture switches.
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
    # The base of a robot that floats follows the target, which is no switch.
    own = slice(3, None) if problem.robot.floating else slice(None)
    for row, line in enumerate(postures):
        for column, q in enumerate(line):
            for other in ((row, column + 1), (row + 1, column)):
                if other[0] < len(postures) and other[1] < len(line) and q is not None:
                    next_to = postures[other[0]][other[1]]
                    if next_to is not None:
                        size = float(np.linalg.norm(wrapped_difference(problem, q, next_to)[own]))
                        steps.append((size, (row, column), other))
    usual = float(np.quantile([size for size, _, _ in steps], 0.25)) if steps else 0.0
    return [(one, other) for size, one, other in steps if size > max(SWITCH, _UNUSUAL * usual)]


def _best(data: Any, grid: Grid, number: int, values: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the point with the least objective of a case; empty if it has none."""
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
        found = table.value[np.isfinite(table.value)]
        wide = found.size > 0 and found.min() > 0 and found.max() > _WIDE * found.min()
        edges = np.arange(columns + 1) - 0.5, np.arange(rows + 1) - 0.5
        drawn = panel.pcolormesh(*edges, np.ma.masked_invalid(table.value), norm=LogNorm() if wide else None)
        if found.size:
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
        if found.size:
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


def _edge(one: tuple[int, int], other: tuple[int, int]) -> list[tuple[float, float]]:
    """Return the border between two cells."""
    row, column = (np.array(one) + np.array(other)) / 2
    if one[0] == other[0]:
        return [(column, row - 0.5), (column, row + 0.5)]
    return [(column - 0.5, row), (column + 0.5, row)]


def _label(axis: Any, own: Axis) -> None:
    """Label an axis of a panel with a few of its values."""
    count = len(own.values)
    shown = np.unique(np.linspace(0, count - 1, min(count, _TICKS)).round().astype(int))
    # Entries of a vector stand below each other on the axis across, where long labels would meet.
    space = "\n" if axis.axis_name == "x" and isinstance(own.values[0], tuple) else " "
    axis.set_ticks(shown, [plot_label(_short(own.values[k])).replace(" ", space) for k in shown])
    axis.set_label_text(plot_label(own.name + (" offset, m" if own.name in "xyz" else "")))


def _short(value: Any) -> str:
    values = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in values)
