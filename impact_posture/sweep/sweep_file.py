"""Content of ``SWEEP.toml``: one posture problem, and the settings that vary over a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np

from impact_posture.config.demand import between
from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import StrictTable, read_toml, validate
from impact_posture.errors import SpecError, nearest, printable
from impact_posture.impact.impact_contact import LARGEST
from impact_posture.robot.robot_loader import from_folder

# Axes along which one nonlinear program is used for all values, from the slowest to the fastest.  ``x``, ``y`` and
# ``z`` are offsets of the target.
OFFSETS = ("x", "y", "z")
InnerAxis = Literal["normal", "target_quaternion", "target_position", "x", "y", "z", "speed"]
_INNER = get_args(InnerAxis)
# Settings that cannot be an axis, because they concern the search or the output.
_NO_AXIS = ("schema", "q", "starts", "seed", "tradeoff", "tradeoff_against", "path", "strike", "search",
            "finish_all", "contact")  # fmt: skip
_FILES = ("srdf", "config", "weights", "armature", "posture")
# Maximum number of points of a grid, so that every index is a 64-bit integer.
_MOST = 10**15
# Maximum number of combinations of values that need separate programs, because the settings of all combinations are
# in memory.
_MOST_CASES = 10**5
# A grid point is warm started from at most this number of neighbors, which lie along the axes that vary fastest.
_NEIGHBORS = 2


@dataclass(frozen=True)
class Axis:
    """Axis of a grid: values of a setting, or of ``x``, ``y`` or ``z`` (offset of the target, world, m).

    The values have the same order as in the file.
    """

    name: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Grid:
    """All combinations of the values of several axes.  The last axis varies fastest."""

    axes: tuple[Axis, ...]

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis."""
        return tuple(len(axis.values) for axis in self.axes)

    @property
    def size(self) -> int:
        """Number of points of the grid."""
        return prod(self.shape)

    def place(self, point: int) -> tuple[int, ...]:
        """Return the index of a grid point on each axis."""
        return tuple(int(k) for k in np.unravel_index(point, self.shape))

    def values(self, point: int) -> dict[str, Any]:
        """Return the value of each axis at a grid point."""
        return {axis.name: axis.values[k] for axis, k in zip(self.axes, self.place(point), strict=True)}

    def neighbors(self, point: int, first: int) -> list[int]:
        """Return up to two neighbors of ``point`` with indices from ``first`` to ``point - 1``.

        Neighbors along the axis that varies fastest come first.
        """
        return [other for other in self.around(point) if first <= other < point][:_NEIGHBORS]

    def around(self, point: int) -> list[int]:
        """Return the neighbors of ``point`` on both sides along every axis.

        The neighbors along the axis that varies fastest come first.
        """
        neighbors: list[int] = []
        stride = 1
        for count, k in zip(reversed(self.shape), reversed(self.place(point)), strict=True):
            neighbors += [point - stride] * (k > 0) + [point + stride] * (k + 1 < count)
            stride *= count
        return neighbors


@dataclass(frozen=True)
class SweepSettings(StrictTable):
    """Content of a ``SWEEP.toml``.

    Attributes:
        problem: Table with the keys of a ``problem.toml``, or the path of a ``problem.toml``.
        grid: Axis name → values, as a list or as a table with ``from``, ``to`` and ``count``.
        shard: Number of points of a shard.  A shard is solved and written as a unit.
        schema: Name of this file format.
    """

    problem: str | dict[str, Any]
    grid: dict[str, Any]
    shard: Annotated[int, between(1, 1e6, "points")] = 256
    schema: Literal["impact-posture/sweep/1"] = "impact-posture/sweep/1"


@dataclass(frozen=True)
class Case:
    """One combination of values of the outer axes.  Each combination needs its own nonlinear program.

    Attributes:
        settings: Settings of the problem at the first point of the grid.
        values: Values of the outer axes, by name.
    """

    settings: ProblemSettings
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Sweep:
    """All problems of a ``SWEEP.toml``.

    Attributes:
        cases: Combinations of robot parameters, objectives and other settings.
        outer: Axes along which the cases vary.
        grid: Grid of targets, normals and speeds, the same for every case.
        shard: Number of points of a shard.
    """

    cases: tuple[Case, ...]
    outer: tuple[Axis, ...]
    grid: Grid
    shard: int

    @property
    def points(self) -> int:
        """Number of problems of the sweep."""
        return len(self.cases) * self.grid.size

    @property
    def shards(self) -> int:
        """Number of shards of the sweep.  All points of a shard belong to the same :class:`Case`."""
        return len(self.cases) * self.shards_of_case

    @property
    def shards_of_case(self) -> int:
        """Number of shards of each case."""
        return -(-self.grid.size // self.shard)

    @property
    def passes(self) -> int:
        """Number of passes over each shard.  The second pass uses the optima of neighboring shards."""
        return 1 if self.shards_of_case == 1 else 2

    def span(self, shard: int) -> tuple[int, range]:
        """Return the number of the case to which a shard belongs, and the indices of its grid points."""
        case, part = divmod(shard, self.shards_of_case)
        first = part * self.shard
        return case, range(first, min(first + self.shard, self.grid.size))

    def beside(self, shard: int) -> dict[int, list[int]]:
        """Return the grid points next to the points of a shard: number of another shard → its points."""
        case, points = self.span(shard)
        neighbors: dict[int, list[int]] = {}
        for other in sorted({other for point in points for other in self.grid.around(point)}.difference(points)):
            neighbors.setdefault(case * self.shards_of_case + other // self.shard, []).append(other)
        return neighbors


def read_sweep(path: Path) -> Sweep:
    """Read a ``SWEEP.toml``.  Paths in the file are relative to its folder.

    Raises:
        SpecError: A key is unknown or missing, or a value is invalid.
    """
    settings, folder = validate(SweepSettings, read_toml(path), str(path)), path.resolve().parent
    if isinstance(settings.problem, str):
        file = folder / settings.problem
        where, problem = str(file), from_folder(read_toml(file), file.parent, _FILES)
    else:
        where, problem = f"{path}: problem", from_folder(settings.problem, folder, _FILES)
    sizes = {name: _size(table, f"{path}: grid.{name}") for name, table in settings.grid.items()}
    outer = [name for name in sizes if name not in _INNER]
    inner = [name for name in _INNER if name in sizes]
    _check_names([*outer, *inner], f"{path}: grid")
    for count, most, words in (
        (prod(sizes.values()), _MOST, "points"),
        (prod(sizes[name] for name in outer), _MOST_CASES, f"combinations of {', '.join(outer)}"),
    ):
        if count > most:
            raise SpecError(f"has {count} {words}", where=f"{path}: grid", hint=f"give at most {most:.0e}")
    values = {name: _values(name, table) for name, table in settings.grid.items()}
    if "contact" in problem:
        raise SpecError(
            "a sweep supports only one contact", where=f"{where}.contact", hint="give `frame` and `normal`"
        )
    first = {name: values[name][0] for name in inner if name not in OFFSETS}
    first_settings = validate(ProblemSettings, problem | first | {name: values[name][0] for name in outer}, where)
    axes = tuple(Axis(name, _checked(name, values[name], problem | first, f"{path}: grid")) for name in inner)
    for name in outer:
        _checked(name, values[name], problem | first, f"{path}: grid")
    if first_settings.tradeoff or first_settings.path or first_settings.search == "global":
        raise SpecError(
            "a sweep does not support `tradeoff`, `path` and the search `global`",
            where=where,
            hint="remove these keys",
        )
    # A speed in the problem can select the objective, but a speed on a grid axis must not.
    stated = {name: value for name, value in (problem | first).items() if name != "speed" or "speed" not in first}
    cases = []
    for combination in product(*(values[name] for name in outer)):
        case = dict(zip(outer, combination, strict=True))
        table = from_folder(stated | case, folder, [name for name in _FILES if name in outer])
        cases.append(Case(validate(ProblemSettings, table, str(path)), case))
    return Sweep(tuple(cases), tuple(Axis(name, values[name]) for name in outer), Grid(axes), settings.shard)


def _size(axis: Any, where: str) -> int:
    """Return the number of values of an axis, which is a list or ``{from, to, count}``."""
    if isinstance(axis, dict):
        low, high, count = (axis.get(key, "") for key in ("from", "to", "count"))
        ends = all(type(v) in (int, float) and abs(v) <= LARGEST for v in (low, high))
        if not ends or set(axis) != {"from", "to", "count"} or type(count) is not int or not 2 <= count <= 10**6:
            raise SpecError("is not a range", where=where, hint="give from, to and count (2 to 1e6), or a list")
        return count
    if not isinstance(axis, list) or not axis:
        raise SpecError("is not an axis", where=where, hint="give a list of values, or { from, to, count }")
    return len(axis)


def _values(name: str, axis: Any) -> tuple[Any, ...]:
    if isinstance(axis, dict):
        low, high, count = axis["from"], axis["to"], axis["count"]
        # Round, so that values such as 0.1 and 0 are exact.
        even = [low + (high - low) * k / (count - 1) for k in range(count)]
        return tuple(0.0 if abs(v) < 1e-12 * abs(high - low) else float(f"{v:.12g}") for v in even)
    # Keep larger integers, because they may overflow as a float.  The check of the setting rejects these integers
    # later.
    return tuple(float(v) if name in _INNER and type(v) is int and abs(v) <= LARGEST else v for v in axis)


def _check_names(names: Sequence[str], where: str) -> None:
    known = [*OFFSETS, *(field.name for field in fields(ProblemSettings) if field.name not in _NO_AXIS)]
    for name in names:
        if name in _NO_AXIS:
            raise SpecError(f"'{name}' cannot vary", where=where, hint="set it in the problem")
        if name not in known:
            what, hint = f"unknown axis '{printable(name, longest=60)}'", ", ".join(nearest(name, known))
            raise SpecError(what, where=where, hint=f"did you mean {hint}?")


def _checked(name: str, values: Sequence[Any], problem: dict[str, Any], where: str) -> tuple[Any, ...]:
    # An offset obeys the same rules as an entry of ``target_position``.
    key, wrap = ("target_position", lambda v: [v, 0.0, 0.0]) if name in OFFSETS else (name, lambda v: v)
    checked = []
    for k, value in enumerate(values):
        try:
            setting = getattr(validate(ProblemSettings, problem | {key: wrap(value)}, where), key)
        except SpecError as error:
            what = error.what.replace(f"'{key}", f"'{name}")
            raise SpecError(what, where=f"{where}.{name}[{k}]", hint=error.hint) from None
        checked.append(setting[0] if name in OFFSETS else setting)
    if len(set(map(repr, checked))) < len(checked):
        raise SpecError("has a value twice", where=f"{where}.{name}", hint="remove one of the equal values")
    return tuple(checked)
