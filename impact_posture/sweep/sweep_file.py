"""``SWEEP.toml``: one posture problem, and the values that vary over a grid, in the order of its points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from impact_posture.config.demand import between
from impact_posture.config.settings import ProblemSettings
from impact_posture.config.table_validation import StrictTable, read_toml, validate
from impact_posture.errors import SpecError, nearest, printable
from impact_posture.impact.impact_contact import LARGEST
from impact_posture.robot.robot_loader import from_folder

# Axes that one program serves, from the slowest to the fastest.  ``x``, ``y`` and ``z`` are offsets of the target.
OFFSETS = ("x", "y", "z")
_INNER = ("normal", "target_quaternion", "target_position", *OFFSETS, "speed")
# Settings that belong to one optimization, to its search or to its output.
_NO_AXIS = ("schema", "q", "starts", "seed", "tradeoff", "tradeoff_against", "path", "search", "finish_all",
            "contact")  # fmt: skip
_FILES = ("srdf", "config", "weights", "armature", "posture")
# Most points of a grid, which keeps every index a 64-bit integer.
_MOST = 10**15
# Most combinations of values that need a program of their own.  The settings of each stay in memory.
_MOST_CASES = 10**5
# Neighbors from which a point is warm started: those along the fastest axes.
_NEIGHBORS = 2


@dataclass(frozen=True)
class Axis:
    """One varied value.

    Attributes:
        name: ``x``, ``y`` or ``z`` (an offset, world, meters), or the name of a setting.
        values: Its values, in the order of the file.
    """

    name: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Grid:
    """All combinations of the values of several axes; the last axis varies fastest.

    Attributes:
        axes: The axes, from the slowest to the fastest.
    """

    axes: tuple[Axis, ...]

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each axis."""
        return tuple(len(axis.values) for axis in self.axes)

    @property
    def size(self) -> int:
        """Number of points."""
        return prod(self.shape)

    def place(self, point: int) -> tuple[int, ...]:
        """Return the index of a point on each axis."""
        return tuple(int(k) for k in np.unravel_index(point, self.shape))

    def values(self, point: int) -> dict[str, Any]:
        """Return the value of each axis at a point."""
        return {axis.name: axis.values[k] for axis, k in zip(self.axes, self.place(point), strict=True)}

    def neighbors(self, point: int, first: int) -> list[int]:
        """Return the neighbors before ``point`` along the fastest axes, not before ``first``, the nearest first.

        They depend on nothing but the grid and the shard, and so do the bytes of the shard.
        """
        return [other for other in self.around(point) if first <= other < point][:_NEIGHBORS]

    def around(self, point: int) -> list[int]:
        """Return the neighbors along all axes, the fastest first: the one before ``point``, then the one after it."""
        found: list[int] = []
        stride = 1
        for count, k in zip(reversed(self.shape), reversed(self.place(point)), strict=True):
            found += [point - stride] * (k > 0) + [point + stride] * (k + 1 < count)
            stride *= count
        return found


@dataclass(frozen=True)
class SweepSettings(StrictTable):
    """Content of a ``SWEEP.toml``.

    Attributes:
        problem: A table with the keys of a ``problem.toml``, or the path of one.
        grid: Values of each axis.
        shard: Points of a shard, which is solved and written as one.
        schema: Name of this format.
    """

    problem: str | dict[str, Any]
    grid: dict[str, Any]
    shard: Annotated[int, between(1, 1e6, "points")] = 256
    schema: Literal["impact-posture/sweep/1"] = "impact-posture/sweep/1"


@dataclass(frozen=True)
class Case:
    """One combination of the values that need a program of their own.

    Attributes:
        settings: The problem at the first point of the grid.
        values: Value of each such axis.
    """

    settings: ProblemSettings
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Sweep:
    """All problems of a ``SWEEP.toml``.

    Attributes:
        cases: Combinations of robot parameters, objectives and other settings.
        outer: The axes of these settings.
        grid: Targets, normals and speeds, the same for every case.
        shard: Points of a shard.
    """

    cases: tuple[Case, ...]
    outer: tuple[Axis, ...]
    grid: Grid
    shard: int

    @property
    def points(self) -> int:
        """Number of problems."""
        return len(self.cases) * self.grid.size

    @property
    def shards(self) -> int:
        """Number of shards; no shard has points of two cases."""
        return len(self.cases) * self.shards_of_case

    @property
    def shards_of_case(self) -> int:
        """Number of shards of each case."""
        return -(-self.grid.size // self.shard)

    @property
    def passes(self) -> int:
        """Number of passes over each shard: the second is for what neighboring shards have found."""
        return 1 if self.shards_of_case == 1 else 2

    def span(self, shard: int) -> tuple[int, range]:
        """Return the case of a shard, and its points as indices of the grid."""
        case, part = divmod(shard, self.shards_of_case)
        first = part * self.shard
        return case, range(first, min(first + self.shard, self.grid.size))

    def beside(self, shard: int) -> dict[int, list[int]]:
        """Return the neighbors of the points of a shard that are in other shards, by their shard."""
        case, points = self.span(shard)
        found: dict[int, list[int]] = {}
        for other in sorted({other for point in points for other in self.grid.around(point)}.difference(points)):
            found.setdefault(case * self.shards_of_case + other // self.shard, []).append(other)
        return found


def read_sweep(path: Path) -> Sweep:
    """Read a ``SWEEP.toml``, whose paths are relative to its folder.

    Raises:
        SpecError: A key is unknown or missing, or a value does not fit; the first fault, in one line.
    """
    settings, folder = validate(SweepSettings, read_toml(path), str(path)), path.resolve().parent
    if isinstance(settings.problem, str):
        at = folder / settings.problem
        where, problem = str(at), from_folder(read_toml(at), at.parent, _FILES)
    else:
        where, problem = f"{path}: problem", from_folder(settings.problem, folder, _FILES)
    sizes = {name: _size(given, f"{path}: grid.{name}") for name, given in settings.grid.items()}
    outer = [name for name in sizes if name not in _INNER]
    inner = [name for name in _INNER if name in sizes]
    _check_names([*outer, *inner], f"{path}: grid")
    for count, most, words in (
        (prod(sizes.values()), _MOST, "points"),
        (prod(sizes[name] for name in outer), _MOST_CASES, f"combinations of {', '.join(outer)}"),
    ):
        if count > most:
            raise SpecError(f"has {count} {words}", where=f"{path}: grid", hint=f"give at most {most:.0e}")
    values = {name: _values(name, given) for name, given in settings.grid.items()}
    if "contact" in problem:
        raise SpecError("a sweep is of one contact", where=f"{where}.contact", hint="give `frame` and `normal`")
    first = {name: values[name][0] for name in inner if name not in OFFSETS}
    made = validate(ProblemSettings, problem | first | {name: values[name][0] for name in outer}, where)
    axes = tuple(Axis(name, _checked(name, values[name], problem | first, f"{path}: grid")) for name in inner)
    for name in outer:
        _checked(name, values[name], problem | first, f"{path}: grid")
    if made.tradeoff or made.path or made.search != "multistart":
        raise SpecError("`tradeoff`, `path` and `search` are for one optimum", where=where, hint="leave them out")
    cases = []
    for chosen in product(*(values[name] for name in outer)):
        of_case = dict(zip(outer, chosen, strict=True))
        own = from_folder(problem | first | of_case, folder, [name for name in _FILES if name in outer])
        cases.append(Case(validate(ProblemSettings, own, str(path)), of_case))
    return Sweep(tuple(cases), tuple(Axis(name, values[name]) for name in outer), Grid(axes), settings.shard)


def _size(given: Any, where: str) -> int:
    """Return the number of values of an axis, a list or ``{from, to, count}``."""
    if isinstance(given, dict):
        low, high, count = (given.get(key, "") for key in ("from", "to", "count"))
        ends = all(type(v) in (int, float) and abs(v) <= LARGEST for v in (low, high))
        if not ends or set(given) != {"from", "to", "count"} or type(count) is not int or not 2 <= count <= 10**6:
            raise SpecError("is no range", where=where, hint="give from, to and count (2 to 1e6), or a list")
        return count
    if not isinstance(given, list) or not given:
        raise SpecError("is no axis", where=where, hint="give a list of values, or { from, to, count }")
    return len(given)


def _values(name: str, given: Any) -> tuple[Any, ...]:
    """Return the values of an axis that has a :func:`_size`."""
    if isinstance(given, dict):
        low, high, count = given["from"], given["to"], given["count"]
        # Rounded, so that a tenth is a tenth and zero is zero.
        even = [low + (high - low) * k / (count - 1) for k in range(count)]
        return tuple(0.0 if abs(v) < 1e-12 * abs(high - low) else float(f"{v:.12g}") for v in even)
    # A larger integer may be no float.  The demand of the setting refuses it.
    return tuple(float(v) if name in _INNER and type(v) is int and abs(v) <= LARGEST else v for v in given)


def _check_names(names: Sequence[str], where: str) -> None:
    known = [*OFFSETS, *(field.name for field in fields(ProblemSettings) if field.name not in _NO_AXIS)]
    for name in names:
        if name in _NO_AXIS:
            raise SpecError(f"'{name}' cannot vary", where=where, hint="set it in the problem")
        if name not in known:
            close = ", ".join(nearest(name, known))
            raise SpecError(
                f"unknown axis '{printable(name, longest=60)}'", where=where, hint=f"did you mean {close}?"
            )


def _checked(name: str, values: Sequence[Any], problem: dict[str, Any], where: str) -> tuple[Any, ...]:
    """Return the values as the settings hold them; those of offsets are finite numbers."""
    # An offset has the demand of one entry of a position.
    key, wrap = ("target_position", lambda v: [v, 0.0, 0.0]) if name in OFFSETS else (name, lambda v: v)
    found = []
    for k, value in enumerate(values):
        try:
            made = getattr(validate(ProblemSettings, problem | {key: wrap(value)}, where), key)
        except SpecError as error:
            raise SpecError(
                error.what.replace(f"'{key}", f"'{name}"), where=f"{where}.{name}[{k}]", hint=error.hint
            ) from None
        found.append(made[0] if name in OFFSETS else made)
    if len(set(map(repr, found))) < len(found):
        raise SpecError("has a value twice", where=f"{where}.{name}", hint="leave one of them out")
    return tuple(found)
