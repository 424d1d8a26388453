"""The search for a path on the constraints: walks, the whole self-motion curve, samples; then a shorter path."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from impact_posture.arrays import Array
from impact_posture.path.path_space import STEP, PathSpace
from impact_posture.path.sampling import sampled_path
from impact_posture.posture.problem import equality_jacobian, null_space, rank

# Postures that the sampling planner may take for a target.
SAMPLES = 2000
# The end of a self-motion curve is found within this tangent length.
_CURVE_END = 1e-4
# Steps on a self-motion curve: 500 rad at the usual step, more than any curve within joint limits.
_CURVE_STEPS = 10_000
# A path is shortened if it exceeds the straight distance of its ends by more than a share: by an elastic band, and
# before it by shortcuts, whose walks cost more.
_BENT, _DETOUR = 0.02, 0.2
_SHORTCUTS = 24
# Postures of the elastic bands, and sweeps over each.
_BANDS, _SWEEPS = (9, 17, 33), 12


class PathSearch:
    """Paths from one posture to several targets.

    Args:
        space: The postures that the constraints allow.
        start: First posture of all paths, shape (nq,), valid.
        seed: Seed of the samples.
        samples: Postures that the sampling planner may take for a target.

    Attributes:
        visited: Postures that are reached from the start.
        method: How the last path was found: ``continuation``, ``self-motion curve`` or ``sampling``.
    """

    def __init__(self, space: PathSpace, start: Array, seed: int = 0, samples: int = SAMPLES) -> None:
        self.space, self.start = space, start
        self._seed, self._samples = seed, samples
        self.visited: list[Array] = [start]
        self.method = ""
        self._curves: list[list[Array]] = []
        self._ended: list[bool] = []

    @property
    def whole(self) -> bool:
        """Whether all postures that can be reached were followed."""
        return bool(self._ended) and all(self._ended)

    def to(self, target: Array) -> list[Array] | None:
        """Return postures from the start to ``target``, shape (nq,), with valid motions between them, or ``None``."""
        space, self.method = self.space, "continuation"
        if not space.valid(target):
            return None
        forward = space.walk(self.start, target)
        self.visited += forward
        if forward[-1] is target:
            return forward
        backward = space.walk(target, self.start)
        if backward[-1] is self.start:
            return backward[::-1]
        middle = space.walk(forward[-1], backward[-1])
        if middle[-1] is backward[-1]:
            return [*forward, *middle[1:-1], *backward[::-1]]
        if self._redundancy() == 1:
            self.method = "self-motion curve"
            return self._along_curve(target)
        self.method = "sampling"
        path, reached = sampled_path(space, self.start, target, self._seed, self._samples)
        self.visited += reached
        return path

    def _redundancy(self) -> int:
        """The degrees of freedom that the equalities leave at the start."""
        space = self.space
        return int(space.model.nv) - rank(equality_jacobian(space.problem, space.projector.numeric.at(self.start)))

    def _along_curve(self, target: Array) -> list[Array] | None:
        if not self._curves:
            self._curves = [self._curve(1.0), self._curve(-1.0)]
            self.visited += [q for curve in self._curves for q in curve]
        for curve in self._curves:
            nearest = int(np.argmin([self.space.distance(q, target) for q in curve]))
            end = self.space.walk(curve[nearest], target)
            if end[-1] is target:
                return [*curve[:nearest], *end]
        return None

    def _curve(self, sign: float) -> list[Array]:
        """Follow the self-motion curve from the start in one direction, to its end or back to the start.

        A singular posture, at which the curve may branch, is no end.
        """
        space, curve, size = self.space, [self.start], STEP
        direction: Array | None = None
        self._ended.append(False)
        while len(curve) < _CURVE_STEPS and size > _CURVE_END:
            q = curve[-1]
            tangents = null_space(equality_jacobian(space.problem, space.projector.numeric.at(q)))
            if tangents.shape[1] != 1:
                return curve
            tangent = tangents[:, 0] * (sign if direction is None else np.sign(tangents[:, 0] @ direction) or 1.0)
            moved = space.take(q, tangent * size)
            if moved is None or space.difference(q, moved) @ tangent < size / 2:
                size /= 2
                continue
            direction = tangent
            curve.append(moved)
            if len(curve) > 3 and space.distance(moved, self.start) < STEP and size == STEP:
                break
        self._ended[-1] = len(curve) < _CURVE_STEPS
        return curve


def shortened(space: PathSpace, postures: Sequence[Array], seed: int = 0) -> list[Array]:
    """Return a shorter and smoother path between the same ends: shortcuts, then an elastic band on the constraints.

    A shortcut is a walk between two postures of the path that is shorter than the path between them.  The elastic
    band moves each posture to the middle of its neighbors and pulls it onto the constraints, on finer and finer
    bands.  The last band is kept only if its whole motion is valid.  A path that is almost straight stays as it is.
    """
    path, rng = list(postures), np.random.default_rng(seed)
    straight = space.distance(path[0], path[-1])
    for _ in range(_SHORTCUTS):
        if space.length(path) < straight * (1 + _DETOUR):
            break
        i, j = sorted(rng.choice(len(path), 2, replace=False))
        between = space.walk(path[i], path[j]) if j - i > 1 else []
        if between and between[-1] is path[j] and space.length(between) < space.length(path[i : j + 1]):
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


def even(space: PathSpace, postures: Sequence[Array], count: int) -> list[Array]:
    """Return ``count`` postures on the constraints that divide a path evenly, with both ends."""
    lengths = np.array([space.distance(a, b) for a, b in pairwise(postures)])
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    found = [postures[0]]
    for s in np.linspace(0.0, ends[-1], count)[1:-1]:
        k = min(int(np.searchsorted(ends, s, side="right")) - 1, len(lengths) - 1)
        step = space.difference(postures[k], postures[k + 1])
        moved = space.pulled(postures[k], step * ((s - ends[k]) / lengths[k]))
        found.append(postures[k] if moved is None else moved)
    return [*found, postures[-1]]
