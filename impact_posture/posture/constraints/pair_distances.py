"""Distances of many pairs of bodies: exact where they are near, and else lower bounds that cost little."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraints.separating_plane import ConvexBody, SeparatingPlane
from impact_posture.system.arrays import Array


class PairDistances:
    """Distances less the clearance of pairs of bodies, at one posture after another.

    Cheap lower bounds show for most pairs that they are apart: balls around the bodies, the last exact distance less
    what the bodies have moved since, and the gap between the hulls along two directions.  What is known of the last
    posture stays known, because a search looks at a posture several times.

    Args:
        separators: The pairs.
    """

    def __init__(self, separators: Sequence[SeparatingPlane]) -> None:
        self._separators = tuple(separators)
        bodies: dict[int, ConvexBody] = {}
        for one in self._separators:
            bodies |= {id(one.a): one.a, id(one.b): one.b}
        self._bodies = list(bodies.values())
        where = {key: k for k, key in enumerate(bodies)}
        self._first = np.array([where[id(one.a)] for one in self._separators], dtype=int)
        self._second = np.array([where[id(one.b)] for one in self._separators], dtype=int)
        # A body that does not turn keeps world axes around its point.
        self._turns = np.array([body.turns for body in self._bodies], dtype=bool)[:, None, None]
        self._joints, self._on = np.unique([body.point.joint for body in self._bodies], return_inverse=True)
        still = np.where(self._turns[:, 0], 0.0, 1.0)
        centers = np.array([body.center for body in self._bodies]).reshape(-1, 3)
        points = np.array([body.point.position for body in self._bodies]).reshape(-1, 3)
        self._carried, self._beside = ((1 - still) * centers + still * points)[:, :, None], still * centers
        self._reach = np.array([0.0 if body.hull is None else body.hull.reach for body in self._bodies])
        margins = np.array([one.margin for one in self._separators])
        self._ends = (0, self._first), (1, self._second)
        self._least = self._reach[self._first] + self._reach[self._second] + margins
        # Corners of the hulls around their centers, in axes that turn with the body; the last one fills the rows.
        corners = [_corners(body) for body in self._bodies]
        most = max((len(own) for own in corners), default=0)
        filled = [np.vstack([own, np.repeat(own[-1:], most - len(own), axis=0)]) for own in corners]
        self._corners = np.array(filled).reshape(len(corners), most, 3)
        self._gaps = np.array([one.gap for one in self._separators])
        self._planes = [(k, body) for k, body in enumerate(self._bodies) if body.normal is not None]
        self._offsets = np.array([body.offset for body in self._bodies])
        self._known = np.array([one.known for one in self._separators], dtype=bool)
        # The last exact distance of each pair of hulls, its normal, and the places of its bodies then.
        self._latest = np.full(len(self._separators), -np.inf)
        self._normals = np.zeros((len(self._separators), 3))
        self._then = np.zeros((2, len(self._separators), 12))
        # The last posture, the bodies there, the normals of planes, and what is known of the distances.
        self._q = np.zeros(0)
        self._axes, self._centers = np.zeros((0, 3, 3)), np.zeros((0, 3))
        self._up = np.zeros((len(self._bodies), 3))
        self._balls = self._values = np.zeros(0)
        self._exact = np.zeros(len(self._separators), dtype=bool)

    def bounds(self, model: Numeric, pairs: range) -> Array:
        """Return lower bounds on the distances of some pairs from a ball around each body, m."""
        self._move(model)
        return np.array(self._balls[pairs.start : pairs.stop])

    def within(self, model: Numeric, limit: float, pairs: range) -> Array:
        """Return the distances of some pairs, m: exact below a limit, and else exact or lower bounds.

        Args:
            model: The model at the posture.
            limit: The limit, m.
            pairs: The pairs.
        """
        self._move(model)
        own = slice(pairs.start, pairs.stop)
        near = pairs.start + np.flatnonzero((self._values[own] < limit) & ~self._exact[own])
        if near.size:
            hulls = near[~self._known[near]]
            if hulls.size:
                moved = [_moved(self._places(ends[hulls]), self._then[k, hulls]) for k, ends in self._ends]
                self._values[hulls] = np.maximum(self._values[hulls], self._latest[hulls] - moved[0] - moved[1])
            near = near[self._values[near] < limit]
        if near.size:
            self._values[near] = np.maximum(self._values[near], self._along(near))
            self._exact[near] |= self._known[near]
        for k in near[(self._values[near] < limit) & ~self._known[near]].tolist():
            self._values[k], self._normals[k], _ = self._separators[k].distance(model)
            self._latest[k], self._exact[k] = self._values[k], True
            self._then[:, k] = self._places(np.array([self._first[k], self._second[k]]))
        return self._values[own].copy()

    def _move(self, model: Numeric) -> None:
        """Place all bodies, unless the posture is the last one."""
        if np.array_equal(self._q, model.q):
            return
        self._q = model.q
        self._exact[:] = False
        oMi = model.data.oMi
        links = np.array([oMi[joint].homogeneous for joint in self._joints.tolist()])[self._on]
        axes = links[:, :3, :3]
        self._centers = (axes @ self._carried)[:, :, 0] + links[:, :3, 3] + self._beside
        self._axes = np.where(self._turns, axes, np.eye(3))
        for k, body in self._planes:
            self._up[k] = body.placement(model).rotation @ body.normal
        apart = self._centers[self._first] - self._centers[self._second]
        heights = (apart * self._up[self._second]).sum(axis=1) - self._offsets[self._second]
        bound = np.where(self._known, heights, np.sqrt((apart * apart).sum(axis=1)))
        self._balls = bound - self._least
        self._values = self._balls.copy()

    def _places(self, bodies: Array) -> Array:
        """Return the axes times the reach, and the center of bodies, shape (k, 12)."""
        axes = self._axes[bodies] * self._reach[bodies][:, None, None]
        return np.hstack([axes.reshape(-1, 9), self._centers[bodies]])

    def _along(self, pairs: NDArray[np.intp]) -> Array:
        """Return the gaps of pairs along the normal of the plane, or the larger one along two directions, m."""
        first, second = self._first[pairs], self._second[pairs]
        apart = self._centers[first] - self._centers[second]
        # The direction between the centers, and the normal when the pair was near.
        length = np.sqrt((apart * apart).sum(axis=1, keepdims=True))
        between = apart / np.maximum(length, np.finfo(float).tiny)
        along = np.stack(
            [np.where(self._known[pairs, None], self._up[second], between), self._normals[pairs]], axis=2
        )
        low = (self._corners[first] @ (self._axes[first].transpose(0, 2, 1) @ along)).min(axis=1)
        high = (self._corners[second] @ (self._axes[second].transpose(0, 2, 1) @ along)).max(axis=1)
        gaps = (apart[:, None] @ along)[:, 0] + low - high
        # A pair that was never near has no normal, and a gap of zero along it.
        best = np.where(self._normals[pairs].any(axis=1), gaps.max(axis=1), gaps[:, 0])
        return np.asarray(best - self._gaps[pairs] - self._offsets[second])


def _corners(body: ConvexBody) -> Array:
    """Return the corners of a hull around its center, in axes that turn with the body; one of a half-space."""
    if body.hull is None:
        return np.zeros((1, 3))
    corners = body.hull.vertices - body.hull.center
    return np.asarray(corners @ body.point.rotation.T if body.turns else corners)


def _moved(now: Array, then: Array) -> Array:
    """Return how far a point of each body has moved at most, ``|Δc| + |ΔR| r``, m, shape (k,).

    Args:
        now: Axes ``R`` times reach ``r``, and center ``c`` of each body, shape (k, 12).
        then: The same before.
    """
    change = (now - then) ** 2
    return np.asarray(np.sqrt(change[:, 9:].sum(axis=1)) + np.sqrt(change[:, :9].sum(axis=1)))
