"""The grid of a sweep: its axes, the order of its points, and which earlier points are neighbors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

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
        found = []
        for count in reversed(self.shape):
            point, k = divmod(point, count)
            found.append(k)
        return tuple(reversed(found))

    def values(self, point: int) -> dict[str, Any]:
        """Return the value of each axis at a point."""
        return {axis.name: axis.values[k] for axis, k in zip(self.axes, self.place(point), strict=True)}

    def neighbors(self, point: int, first: int) -> list[int]:
        """Return the neighbors before ``point`` along the fastest axes, not before ``first``, the nearest first.

        They depend on nothing but the grid and the shard, and so do the bytes of the shard.
        """
        found: list[int] = []
        stride = 1
        for count, k in zip(reversed(self.shape), reversed(self.place(point)), strict=True):
            if k and point - stride >= first and len(found) < _NEIGHBORS:
                found.append(point - stride)
            stride *= count
        return found

    def around(self, point: int) -> list[int]:
        """Return the neighbors of ``point`` along all axes, the one before it and then the one after it."""
        found: list[int] = []
        stride = 1
        for count, k in zip(reversed(self.shape), reversed(self.place(point)), strict=True):
            found += [point - stride] * (k > 0) + [point + stride] * (k + 1 < count)
            stride *= count
        return found
