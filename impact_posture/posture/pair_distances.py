"""Distances of many pairs of bodies: exact where they are near, and else lower bounds that cost little."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.separator import Body, Separator


class PairDistances:
    """Distances less the clearance of pairs of bodies, at one posture after another.

    The balls around two bodies bound their distance.  The last exact distance of a pair, less what its bodies have
    moved since, is a bound as well.  What is known of the last posture stays known, because a search looks at one
    several times.

    Args:
        separators: The pairs.
    """

    def __init__(self, separators: Sequence[Separator]) -> None:
        self._separators = tuple(separators)
        bodies: dict[int, Body] = {}
        for one in self._separators:
            bodies |= {id(one.a): one.a, id(one.b): one.b}
        self._bodies = list(bodies.values())
        where = {key: k for k, key in enumerate(bodies)}
        self._first = np.array([where[id(one.a)] for one in self._separators], dtype=int)
        self._second = np.array([where[id(one.b)] for one in self._separators], dtype=int)
        # A body that does not turn keeps world axes around its point.
        self._turns = np.array([body.turns for body in self._bodies], dtype=bool)
        self._joints = np.array([body.point.joint for body in self._bodies], dtype=int)
        still = np.where(self._turns, 0.0, 1.0)[:, None]
        centers = np.array([body.center for body in self._bodies]).reshape(-1, 3)
        points = np.array([body.point.position for body in self._bodies]).reshape(-1, 3)
        self._carried, self._beside = (1 - still) * centers + still * points, still * centers
        self._reach = np.array([0.0 if body.hull is None else body.hull.reach for body in self._bodies])
        margins = np.array([one.margin for one in self._separators])
        self._least = self._reach[self._first] + self._reach[self._second] + margins
        # The last exact distance of each pair and the places of its bodies then; a plane that turns has no reach.
        turning = [body.normal is not None and body.turns and body.point.joint > 0 for body in self._bodies]
        self._lasting = ~np.array(turning, dtype=bool)[self._second]
        self._latest = np.full(len(self._separators), -np.inf)
        self._then = np.zeros((2, len(self._separators), 12))
        self._planes = [
            (self._second == k, body, body.normal, body.offset)
            for k, body in enumerate(self._bodies)
            if body.normal is not None
        ]
        # The last posture, the bodies there, and what is known of the distances.
        self._q = np.zeros(0)
        self._places = np.zeros((0, 12))
        self._values = np.zeros(0)
        self._exact: dict[int, tuple[Array, Array]] = {}

    @property
    def bodies(self) -> list[Body]:
        """The bodies of all pairs."""
        return self._bodies

    @property
    def second(self) -> Array:
        """Index of the second body of each pair, shape (k,)."""
        return self._second

    def bounds(self, model: Numeric) -> Array:
        """Return lower bounds on all distances from a ball around each body, shape (k,), m."""
        return self._bounds(model, self._placed(model)[1])

    def within(self, model: Numeric, limit: float) -> tuple[Array, dict[int, tuple[Array, Array]]]:
        """Return all distances, and the normal and the closest points of those that are exact.

        Args:
            model: The model at the posture.
            limit: Distances below it are exact, others may be lower bounds, m.
        """
        if not np.array_equal(self._q, model.q):
            axes, centers = self._placed(model)
            self._places = np.hstack([axes.reshape(-1, 9) * self._reach[:, None], centers])
            self._values, self._exact, self._q = self._bounds(model, centers), {}, model.q
        values, places = self._values, self._places
        near = [k for k in np.flatnonzero(values < limit).tolist() if k not in self._exact]
        if near:
            now = places[self._first[near]], places[self._second[near]]
            values[near] = np.maximum(values[near], self._latest[near] - sum(map(_moved, now, self._then[:, near])))
        for k in near:
            if values[k] < limit:
                values[k], normal, points = self._separators[k].distance(model)
                self._exact[k] = normal, points
                if self._lasting[k]:
                    self._latest[k], self._then[:, k] = values[k], places[[self._first[k], self._second[k]]]
        return values.copy(), dict(self._exact)

    def _placed(self, model: Numeric) -> tuple[Array, Array]:
        """Return the axes, shape (k, 3, 3), and the centers, shape (k, 3), m, of all bodies in the world."""
        links = np.array([at.homogeneous for at in model.data.oMi])[self._joints]
        centers = (links[:, :3, :3] @ self._carried[:, :, None])[:, :, 0] + links[:, :3, 3] + self._beside
        return np.where(self._turns[:, None, None], links[:, :3, :3], np.eye(3)), centers

    def _bounds(self, model: Numeric, centers: Array) -> Array:
        apart = centers[self._first] - centers[self._second]
        bound = np.sqrt((apart * apart).sum(axis=1))
        for mine, body, normal, offset in self._planes:
            bound[mine] = apart[mine] @ (body.placement(model).rotation @ normal) - offset
        return np.asarray(bound - self._least)


def _moved(now: Array, then: Array) -> Array:
    """Return how far a point of each body has moved at most, ``|Δc| + |ΔR| r``, m, shape (k,).

    Args:
        now: Axes ``R`` times reach ``r``, and center ``c`` of each body, shape (k, 12).
        then: The same before.
    """
    change = (now - then) ** 2
    return np.asarray(np.sqrt(change[:, 9:].sum(axis=1)) + np.sqrt(change[:, :9].sum(axis=1)))
