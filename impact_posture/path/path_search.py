"""Search for a path on the constraints with two trees of walks (:meth:`PathSpace.walk`), and shorten it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from impact_posture.path.path_space import PathSpace
from impact_posture.posture.manifold.feasible_start import random_posture
from impact_posture.system.arrays import Array

# Largest number of postures that the search pulls onto the constraints for a target.
EFFORT = 5000
# An elastic band shortens a path that is longer than the straight distance by more than the share ``_BENT``.  Beyond
# the share ``_DETOUR``, shortcuts, which need more time, shorten the path first.
_BENT, _DETOUR = 0.02, 0.2
_SHORTCUTS = 24
# Number of postures of each elastic band (:func:`shortened`).
_BANDS = (9, 17, 33)
# Number of times that all postures of a band are moved.
_SWEEPS = 12


@dataclass(frozen=True, eq=False)
class Connection:
    """Result of a search between two postures; ``method`` is ``continuation``, or ``sampling`` of random postures.

    The motions between successive postures of ``path`` are valid; ``None`` means that the search failed.  ``reached``
    contains all postures that the search reached from the start.  ``proof`` is the reason why no path exists; empty
    if this is not proved.
    """

    path: list[Array] | None
    reached: list[Array]
    method: str
    proof: str = ""


class _Tree:
    """Tree of the postures that walks from a root reach, with the tangent coordinates of postures at the root."""

    def __init__(self, space: PathSpace, root: Array) -> None:
        self._space = space
        self.postures, self._parents = [root], [-1]
        self._places = np.zeros((1, space.model.nv))

    def extend(self, target: Array) -> int:
        """Walk from the nearest posture towards a target; return the index of the last posture."""
        root = self.postures[0]
        last = int(np.argmin(np.linalg.norm(self._places - self._space.difference(root, target), axis=1)))
        walked = self._space.walk(self.postures[last], target)[1:]
        for q in walked:
            self.postures.append(q)
            self._parents.append(last)
            last = len(self.postures) - 1
        self._places = np.vstack([self._places, *[self._space.difference(root, q) for q in walked]])
        return last

    def branch(self, index: int) -> list[Array]:
        """Return the postures from the root to the posture with this index."""
        branch = []
        while index >= 0:
            branch.append(self.postures[index])
            index = self._parents[index]
        return branch[::-1]


def connect(space: PathSpace, start: Array, target: Array, seed: int = 0, effort: int = EFFORT) -> Connection:
    """Search for a path with two trees of walks from both ends, which grow towards each other and random postures.

    The method is CBiRRT (Berenson et al. 2009).  The planners of OMPL 2.0 on projected state spaces stop at
    inequalities, while these walks slide along them.  On a planar arm beside discs, OMPL found 5 of 18 paths in the
    time in which these trees found 18.

    Both ends, shape (nq,), must be valid.  The search ends after ``effort`` postures pulled onto the constraints.
    The effort does not depend on time, so the result depends only on the seed.
    """
    rng, chart = np.random.default_rng(seed), space.projector.chart
    first, second = _Tree(space, start), _Tree(space, target)
    growing, other, attempt, begun = first, second, 0, space.pulls
    while space.pulls - begun <= effort:
        near = space.problem.given if attempt % 4 < 2 else None
        aim = random_posture(space.problem, chart, rng, near) if attempt else target
        end = growing.extend(aim)
        meeting = growing.postures[end]
        last = 0 if meeting is target else other.extend(meeting)
        if other.postures[last] is meeting:
            halves = growing.branch(end), other.branch(last)[-2::-1]
            path = [*halves[0], *halves[1]] if growing is first else [*halves[1][::-1], *halves[0][::-1]]
            return Connection(path, first.postures, "sampling" if attempt else "continuation")
        growing, other, attempt = other, growing, attempt + 1
    return Connection(None, first.postures, "sampling")


def shortened(space: PathSpace, postures: Sequence[Array], seed: int = 0) -> list[Array]:
    """Return a shorter and smoother path between the same ends, by shortcuts and then an elastic band.

    A shortcut is a walk between two postures of the path that is shorter than the path between them.  The elastic
    band moves each posture to the middle of its neighbors and pulls it onto the constraints.  Several bands with more
    and more postures are tried in turn, and the last band is returned if its whole motion is valid.  An almost
    straight path does not change.
    """
    path, rng = list(postures), np.random.default_rng(seed)
    straight = space.distance(path[0], path[-1])
    for _ in range(_SHORTCUTS):
        if space.length(path) < straight * (1 + _DETOUR):
            break
        i, j = sorted(rng.choice(len(path), 2, replace=False))
        length = space.length(path[i : j + 1])
        if space.distance(path[i], path[j]) * (1 + _BENT) < length:
            between = space.walk(path[i], path[j], length)
            if between[-1] is path[j] and space.length(between) < length:
                path = [*path[:i], *between, *path[j + 1 :]]
    if space.length(path) < straight * (1 + _BENT):
        return path
    band = path
    for count in _BANDS:
        band = even(space, band, count)
        for _ in range(_SWEEPS):
            for k in range(1, count - 1):
                to_middle = (space.difference(band[k], band[k - 1]) + space.difference(band[k], band[k + 1])) / 2
                moved = space.pulled(band[k], to_middle)
                band[k] = band[k] if moved is None else moved
    return band if space.length(band) < space.length(path) and space.clear_path(band) else path


def even(
    space: PathSpace, postures: Sequence[Array], count: int, sizes: Sequence[float] | None = None
) -> list[Array]:
    """Return ``count`` postures on the constraints that divide a path evenly, including both ends.

    ``sizes`` are the sizes of the steps between postures; the default is their tangent lengths.
    """
    whole = space.length(postures) if sizes is None else sum(sizes)
    inside = placed(space, postures, np.linspace(0.0, whole, count)[1:-1], sizes)
    return [postures[0], *inside, postures[-1]]


def placed(
    space: PathSpace, postures: Sequence[Array], places: Iterable[float], sizes: Sequence[float] | None = None
) -> list[Array]:
    """Return the postures on the constraints at sizes from the beginning of a path, as in :func:`even`."""
    lengths = np.array([space.distance(a, b) for a, b in pairwise(postures)] if sizes is None else sizes)
    ends, divided = np.concatenate([[0.0], np.cumsum(lengths)]), list[Array]()
    for s in places:
        k = min(int(np.searchsorted(ends, s, side="right")) - 1, len(lengths) - 1)
        step = space.difference(postures[k], postures[k + 1])
        moved = space.pulled(postures[k], step * ((s - ends[k]) / lengths[k]))
        divided.append(postures[k] if moved is None else moved)
    return divided
