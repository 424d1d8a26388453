"""Distances of many pairs of bodies: exact for near pairs, and fast lower bounds for distant pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraints.separating_plane import ConvexBody, SeparatingPlane
from impact_posture.system.arrays import Array


class PairDistances:
    """Distances of pairs of bodies, minus the clearance, for a sequence of postures.

    Two fast lower bounds show that most pairs are far apart.  The first bound is the distance between balls around
    the bodies.  The second bound is the gap between the hulls along a direction; two directions are tried, and the
    larger gap is used.  The values at the last posture are stored, because a search evaluates postures repeatedly.
    """

    def __init__(self, pairs: Sequence[SeparatingPlane]) -> None:
        self._pairs = tuple(pairs)
        bodies: dict[int, ConvexBody] = {}
        for pair in self._pairs:
            bodies |= {id(pair.a): pair.a, id(pair.b): pair.b}
        self._bodies = list(bodies.values())
        where = {key: k for k, key in enumerate(bodies)}
        self._first = np.array([where[id(pair.a)] for pair in self._pairs], dtype=int)
        self._second = np.array([where[id(pair.b)] for pair in self._pairs], dtype=int)
        # Bodies that do not turn with their link have world axes.
        self._turns = np.array([body.turns for body in self._bodies], dtype=bool)[:, None, None]
        self._joints = np.array([body.point.joint for body in self._bodies], dtype=int)
        still = np.where(self._turns[:, 0], 0.0, 1.0)
        centers = np.array([body.center for body in self._bodies]).reshape(-1, 3)
        points = np.array([body.point.position for body in self._bodies]).reshape(-1, 3)
        self._carried, self._beside = ((1 - still) * centers + still * points)[:, :, None], still * centers
        self._reach = np.array([0.0 if body.hull is None else body.hull.reach for body in self._bodies])
        margins = np.array([pair.margin for pair in self._pairs])
        self._least = self._reach[self._first] + self._reach[self._second] + margins
        # Corners of each hull relative to its center, in axes that turn with the body.  The last corner of a hull is
        # repeated so that all hulls have the same number of corners.
        corners = [_corners(body) for body in self._bodies]
        most = max(map(len, corners), default=0)
        padded = [np.vstack([points, np.repeat(points[-1:], most - len(points), axis=0)]) for points in corners]
        self._corners = np.array(padded).reshape(len(corners), most, 3)
        self._gaps = np.array([pair.gap for pair in self._pairs])
        self._planes = [(k, body) for k, body in enumerate(self._bodies) if body.normal is not None]
        self._offsets = np.array([body.offset for body in self._bodies])
        self._known = np.array([pair.known for pair in self._pairs], dtype=bool)
        self._behind = np.flatnonzero(self._known)
        # Normal of the last exact distance of each pair of hulls.
        self._normals = np.zeros((len(self._pairs), 3))
        # The last posture, and at this posture the axes and centers of the bodies, the normals of planes, and the
        # distances or bounds.
        self._q = np.zeros(0)
        self._axes, self._centers = np.zeros((0, 3, 3)), np.zeros((0, 3))
        self._up = np.zeros((len(self._bodies), 3))
        self._balls = self._values = np.zeros(0)
        self._exact = np.zeros(len(self._pairs), dtype=bool)
        # All values below this limit, m, are exact.
        self._limit = -np.inf

    def bounds(self, model: Numeric, pairs: range) -> Array:
        """Return lower bounds of the distances of ``pairs``, m, computed with a ball around each body."""
        self._move(model)
        return np.array(self._balls[pairs.start : pairs.stop])

    def within(self, model: Numeric, limit: float, pairs: range) -> Array:
        """Return distances minus clearance of ``pairs``, m; values above ``limit`` (m) may be lower bounds."""
        self._move(model)
        # All constraints need their distances at the same postures, so one computation serves all pairs.
        near = np.flatnonzero((self._values < limit) & ~self._exact) if limit > self._limit else self._behind[:0]
        self._limit = max(limit, self._limit)
        if near.size:
            self._values[near] = np.maximum(self._values[near], self._along(near))
            self._exact[near] |= self._known[near]
        for k in near[(self._values[near] < limit) & ~self._known[near]].tolist():
            self._values[k], self._normals[k], _ = self._pairs[k].distance(model)
            self._exact[k] = True
        return self._values[pairs.start : pairs.stop].copy()

    def _move(self, model: Numeric) -> None:
        """Compute the placements of all bodies, unless the posture did not change since the last call."""
        if np.array_equal(self._q, model.q):
            return
        self._q = model.q
        self._exact[:], self._limit = False, -np.inf
        links = np.array([placement.homogeneous for placement in model.data.oMi.tolist()]).take(self._joints, axis=0)
        axes = links[:, :3, :3]
        self._centers = (axes @ self._carried)[:, :, 0] + links[:, :3, 3] + self._beside
        self._axes = np.where(self._turns, axes, np.eye(3))
        for k, body in self._planes:
            self._up[k] = body.placement(model).rotation @ body.normal
        # ``take`` copies rows five times as fast as an array of indices in brackets.
        apart = self._centers.take(self._first, axis=0) - self._centers.take(self._second, axis=0)
        bound = np.sqrt((apart * apart) @ np.ones(3))
        planes = self._second[self._behind]
        bound[self._behind] = (apart[self._behind] * self._up[planes]).sum(axis=1) - self._offsets[planes]
        self._balls = bound - self._least
        self._values = self._balls.copy()

    def _along(self, pairs: NDArray[np.intp]) -> Array:
        """Return the gap of each pair, m: along the normal of a plane, or the larger gap along two directions."""
        first, second = self._first[pairs], self._second[pairs]
        apart = self._centers.take(first, axis=0) - self._centers.take(second, axis=0)
        # The two directions are the line between the centers and the normal of the last exact distance.
        length = np.sqrt((apart * apart).sum(axis=1, keepdims=True))
        between = apart / np.maximum(length, np.finfo(float).tiny)
        normals = self._normals.take(pairs, axis=0)
        along = np.stack(
            [np.where(self._known[pairs, None], self._up.take(second, axis=0), between), normals], axis=2
        )
        low, high = self._heights(first, along).min(axis=1), self._heights(second, along).max(axis=1)
        gaps = (apart[:, None] @ along)[:, 0] + low - high
        # The normal of a pair is zero until its exact distance is computed.  Until then, only the gap along the line
        # between the centers is used.
        best = np.where(normals.any(axis=1), gaps.max(axis=1), gaps[:, 0])
        return np.asarray(best - self._gaps[pairs] - self._offsets[second])

    def _heights(self, bodies: NDArray[np.intp], along: Array) -> Array:
        """Return the corners, relative to the centers, along world directions ``along``, shape (k, 3, 2)."""
        turned = self._axes.take(bodies, axis=0).transpose(0, 2, 1) @ along
        return np.asarray(self._corners.take(bodies, axis=0) @ turned)


def _corners(body: ConvexBody) -> Array:
    if body.hull is None:
        return np.zeros((1, 3))
    corners = body.hull.vertices - body.hull.center
    return np.asarray(corners @ body.point.rotation.T if body.turns else corners)
