"""Bodies that stay apart: the robot's own links, the surface, the ground and obstacles."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.lifted import Guess
from impact_posture.posture.constraint import Constraint, LiftedRows, Linearization
from impact_posture.posture.separator import EQUATIONS, Body, Corners, Separator

# Pairs closer than this (m) beyond their clearance are computed exactly; a bound is enough for the others.
_NEAR = 0.01
# The certificate sees the rows of pairs closer than this (m) beyond their clearance.
_ROWS = 1e-3
# A pair is missing in the program if it violates its clearance by more than this (m), half of what certifies.
_MISSING = 5e-9
# Most pairs that one posture adds to the program, the deepest first.
_MOST = 6


class Clearance(Constraint):
    """``distance(a, b) − clearance ≥ 0`` for pairs of bodies; the program has the pairs that were found to matter.

    A pair that no solve brings close costs nothing.  :meth:`grown` adds pairs that the end of a solve violates.
    The last exact distance of a pair, less what its bodies have moved since, is a bound as well.

    Args:
        name: Name of the constraint.
        separators: The pairs.
        words: Description in one line.
        active: Pairs in the program, by index, with the corners that have rows there.
        lifted: Equations of pairs by tree and index, which all constraints share that one grows into.
    """

    projected = False
    grows = True

    def __init__(
        self,
        name: str,
        separators: Sequence[Separator],
        words: str,
        active: Mapping[int, Corners] | None = None,
        lifted: WeakKeyDictionary[Tree, dict[int, LiftedRows]] | None = None,
    ) -> None:
        self.name, self._separators, self._words = name, tuple(separators), words
        self.active: Mapping[int, Corners] = active or {}
        self._lifted = WeakKeyDictionary[Tree, dict[int, LiftedRows]]() if lifted is None else lifted
        self.lower, self.upper = np.zeros(len(self._separators)), np.full(len(self._separators), np.inf)
        bodies: dict[int, Body] = {}
        for one in self._separators:
            bodies |= {id(one.a): one.a, id(one.b): one.b}
        self._bodies = list(bodies.values())
        where = {key: k for k, key in enumerate(bodies)}
        self._first = np.array([where[id(one.a)] for one in self._separators], dtype=int)
        self._margins = np.array([one.margin for one in self._separators])
        self._second = np.array([where[id(one.b)] for one in self._separators], dtype=int)
        # A body that does not turn keeps world axes around its point.
        self._turns = np.array([body.turns for body in self._bodies], dtype=bool)
        self._joints = np.array([body.point.joint for body in self._bodies], dtype=int)
        still = np.where(self._turns, 0.0, 1.0)[:, None]
        centers = np.array([body.center for body in self._bodies]).reshape(-1, 3)
        points = np.array([body.point.position for body in self._bodies]).reshape(-1, 3)
        self._carried, self._beside = (1 - still) * centers + still * points, still * centers
        self._reach = np.array([0.0 if body.hull is None else body.hull.reach for body in self._bodies])
        # The last exact distance of each pair and the places of its bodies then; a plane that turns has no reach.
        turning = [body.normal is not None and body.turns and body.point.joint > 0 for body in self._bodies]
        self._lasting = ~np.array(turning, dtype=bool)[self._second]
        self._latest = np.full(len(self._separators), -np.inf)
        self._then = np.zeros((2, len(self._separators), 12))
        self._planes = [
            (k, self._second == k, body.normal, body.offset)
            for k, body in enumerate(self._bodies)
            if body.normal is not None
        ]
        # Programs with other planes are the same.
        self.parameters = np.concatenate([np.zeros(0), *[body.plane for body in self._bodies]])
        self._first_parameter = {k: 4 * index for index, (k, *_) in enumerate(self._planes)}

    def describe(self) -> str:
        """See :class:`Constraint`."""
        return self._words

    @property
    def structure(self) -> str:
        """See :class:`Constraint`."""
        content = "".join(f"{self._own_plane(k)}{one.content(corners)}" for k, one, corners in self._program)
        digest = hashlib.sha256(content.encode()).hexdigest()[:16]
        return f"{super().structure}:{self.parameters.size}:{digest}"

    def row_name(self, row: int) -> str:
        """See :class:`Constraint`."""
        return self._separators[row].name

    def conflicts(self, excess: Array) -> dict[str, float]:
        """See :class:`Constraint`."""
        return {self.row_name(int(k)): float(abs(excess[k])) for k in np.flatnonzero(excess)}

    # ---- numbers ----------------------------------------------------------------------------------------------

    def _placed(self, model: Numeric) -> tuple[Array, Array]:
        """Return the axes, shape (k, 3, 3), and the centers, shape (k, 3), m, of all bodies in the world."""
        links = np.array([at.homogeneous for at in model.data.oMi])[self._joints]
        centers = (links[:, :3, :3] @ self._carried[:, :, None])[:, :, 0] + links[:, :3, 3] + self._beside
        return np.where(self._turns[:, None, None], links[:, :3, :3], np.eye(3)), centers

    def _bounds(self, model: Numeric, centers: Array) -> Array:
        """Return lower bounds on all distances from a sphere around each body."""
        apart = centers[self._first] - centers[self._second]
        bound = np.sqrt((apart * apart).sum(axis=1))
        for k, mine, normal, offset in self._planes:
            bound[mine] = apart[mine] @ (self._bodies[k].placement(model).rotation @ normal) - offset
        return np.asarray(bound - self._reach[self._first] - self._reach[self._second] - self._margins)

    def _distances(self, model: Numeric, within: float) -> tuple[Array, dict[int, tuple[Array, Array]]]:
        """Return all distances, exact below ``within`` and else lower bounds, and normal and points of the former."""
        axes, centers = self._placed(model)
        values, found = self._bounds(model, centers), {}
        near = np.flatnonzero(values < within)
        if near.size:
            places = np.hstack([axes.reshape(-1, 9) * self._reach[:, None], centers])
            now = places[self._first[near]], places[self._second[near]]
            values[near] = np.maximum(values[near], self._latest[near] - sum(map(_moved, now, self._then[:, near])))
        for k in map(int, np.flatnonzero(values < within)):
            values[k], normal, points = self._separators[k].distance(model)
            found[k] = normal, points
            if self._lasting[k]:
                self._latest[k], self._then[:, k] = values[k], places[[self._first[k], self._second[k]]]
        return values, found

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """See :class:`Constraint`; a distance beyond 1 cm may be a lower bound, with a zero Jacobian."""
        values, found = self._distances(model, _NEAR)
        jacobian = np.zeros((self.rows, model.model.nv))
        for k, (normal, points) in found.items():
            one = self._separators[k]
            first, second = (b.rates(model, normal, p[None])[0] for b, p in zip((one.a, one.b), points, strict=True))
            jacobian[k] = first - second
        return values, jacobian

    def value(self, model: Numeric) -> Array:
        """See :class:`Constraint`."""
        return self._distances(model, 0.0)[0]

    def closest(self, model: Numeric) -> tuple[str, float]:
        """Return the pair that is closest, and its distance less the clearance, m."""
        bounds, found = self._bounds(model, self._placed(model)[1]), ("", np.inf)
        for k in np.argsort(bounds, kind="stable"):
            if bounds[k] >= found[1]:
                break
            one = self._separators[int(k)]
            found = min(found, (one.name, one.distance(model)[0]), key=lambda pair: pair[1])
        return found

    def grown(self, model: Numeric) -> Self:
        """See :class:`Constraint`."""
        values, active = self.value(model), dict(self.active)
        added = 0
        for k in np.argsort(values, kind="stable"):
            if values[k] >= -_MISSING or added == _MOST:
                break
            one, old = self._separators[int(k)], active.get(int(k), Corners(frozenset(), frozenset()))
            # A plane of the program that is not the one between the closest points may cut any corner without a row.
            for new in (one.corners(model), one.every_corner):
                if not (new.a <= old.a and new.b <= old.b):
                    active[int(k)] = Corners(old.a | new.a, old.b | new.b)
                    added += 1
                    break
        return type(self)(self.name, self._separators, self._words, active, self._lifted) if added else self

    # ---- lifted form ------------------------------------------------------------------------------------------

    @property
    def _program(self) -> list[tuple[int, Separator, Corners]]:
        return [(k, self._separators[k], corners) for k, corners in self.active.items()]

    def _own_plane(self, k: int) -> slice:
        """Where the plane of a pair with a half-space is among the parameters; empty for another pair."""
        first = self._first_parameter.get(int(self._second[k]))
        return slice(0) if first is None else slice(first, first + 4)

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """See :class:`Constraint`; a pair keeps its equations while others, and more corners, come in."""
        pieces, lifted = [], self._lifted.setdefault(tree, {})
        for k, one, corners in self._program:
            if k not in lifted:
                lifted[k] = one.lift(tree, f"{self.name}{k}", parameters[self._own_plane(k)])
            pair = lifted[k]
            pieces.append(replace(pair, sides=one.sides(pair.variables, corners)))
        return LiftedRows.joined(pieces)

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        """See :class:`Constraint`."""
        equations = np.zeros(EQUATIONS * len(self.active))
        lower, upper = (
            np.concatenate([equations, *[one.bounds(corners)[side] for _, one, corners in self._program]])
            for side in (0, 1)
        )
        return lower, upper

    @property
    def unknowns(self) -> int:
        """See :class:`Constraint`."""
        return sum(one.count for _, one, _ in self._program)

    def guess(self, model: Numeric) -> Guess:
        """See :class:`Constraint`."""
        return Guess.joined([one.guess(model) for _, one, _ in self._program])

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """See :class:`Constraint`; the rows of pairs that are near, in the program or not."""
        near = np.flatnonzero(self._distances(model, _ROWS)[0] < _ROWS)
        own: dict[int, Array] = {}
        if near.size and self.active:
            counts = [one.count for _, one, _ in self._program]
            own = dict(zip(self.active, np.split(auxiliaries, np.cumsum(counts)[:-1]), strict=True))
        parts = [self._separators[int(k)].linearize(model, own.get(int(k))) for k in near]
        return Linearization.joined(parts, model.model.nv)


def _moved(now: Array, then: Array) -> Array:
    """Return how far a point of each body has moved at most, ``|Δc| + |ΔR| r``, m, shape (k,).

    Args:
        now: Axes ``R`` times reach ``r``, and center ``c`` of each body, shape (k, 12).
        then: The same before.
    """
    change = (now - then) ** 2
    return np.asarray(np.sqrt(change[:, 9:].sum(axis=1)) + np.sqrt(change[:, :9].sum(axis=1)))
