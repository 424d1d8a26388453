"""Bodies that stay apart: the robot's own links, the surface, the ground and obstacles."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.posture.constraints.constraint import Constraint, LiftedRows, Linearization
from impact_posture.posture.constraints.pair_distances import PairDistances
from impact_posture.posture.constraints.separating_plane import EQUATIONS, Corners, SeparatingPlane
from impact_posture.system.arrays import Array

# Pairs closer than this (m) beyond their clearance are computed exactly; a bound is enough for the others.
_NEAR = 0.01
# The certificate sees the rows of pairs closer than this (m) beyond their clearance.
_ROWS = 1e-3
# A pair is missing in the program if it violates its clearance by more than this (m), half of what certifies.
_MISSING = 5e-9
# Most pairs that one posture adds to the program, the deepest first: of links, and of links and a plane.  Links
# behind a plane are mostly next to each other, and the deepest takes the others along.
_MOST, _MOST_BEHIND = 6, 2

_Lifted = WeakKeyDictionary[Tree, dict[int, tuple[Corners, LiftedRows]]]


class Clearance(Constraint):
    """``distance(a, b) − clearance ≥ 0`` for pairs of bodies; the program has the pairs that were found to matter.

    A pair that no solve brings close costs nothing.  :meth:`grown` adds pairs that the end of a solve violates.

    Args:
        name: Name of the constraint.
        separators: The pairs.
        words: Description in one line.
        active: Pairs in the program, by index, with the corners that have rows there.
        lifted: Rows of pairs by tree and index with their corners, which all constraints share that one grows into.
        distances: Distances of these pairs and of others, with the places of these; by default made here.
    """

    projected = False
    grows = True

    def __init__(
        self,
        name: str,
        separators: Sequence[SeparatingPlane],
        words: str,
        active: Mapping[int, Corners] | None = None,
        lifted: _Lifted | None = None,
        distances: tuple[PairDistances, range] | None = None,
    ) -> None:
        self.name, self._separators, self._words = name, tuple(separators), words
        self.active: Mapping[int, Corners] = active or {}
        self._lifted = _Lifted() if lifted is None else lifted
        self.lower, self.upper = np.zeros(len(self._separators)), np.full(len(self._separators), np.inf)
        own = range(len(self._separators))
        self._distances, self._own = (PairDistances(separators), own) if distances is None else distances
        planes = {id(one.b): one.b.plane for one in self._separators if one.known}
        # Programs with other planes are the same.
        self.parameters = np.concatenate([np.zeros(0), *planes.values()])
        self._first_parameter = {body: 4 * index for index, body in enumerate(planes)}

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

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """See :class:`Constraint`; a distance beyond 1 cm may be a lower bound, with a zero Jacobian."""
        values = self._distances.within(model, _NEAR, self._own)
        jacobian = np.zeros((self.rows, model.model.nv))
        for k in np.flatnonzero(values < _NEAR):
            one = self._separators[k]
            normal, points = one.distance(model)[1:]
            first, second = (b.rates(model, normal, p[None])[0] for b, p in zip((one.a, one.b), points, strict=True))
            jacobian[k] = first - second
        return values, jacobian

    def value(self, model: Numeric) -> Array:
        """See :class:`Constraint`."""
        return self._distances.within(model, 0.0, self._own)

    def closest(self, model: Numeric) -> tuple[str, float]:
        """Return the pair that is closest, and its distance less the clearance, m."""
        bounds, found = self._distances.bounds(model, self._own), ("", np.inf)
        for k in np.argsort(bounds, kind="stable"):
            if bounds[k] >= found[1]:
                break
            one = self._separators[int(k)]
            found = min(found, (one.name, one.distance(model)[0]), key=lambda pair: pair[1])
        return found

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """See :class:`Constraint`; a pair whose slack makes up for most of its violation needs no more corners."""
        values, active = self.value(model), dict(self.active)
        ends = {} if auxiliaries is None else self._ends(auxiliaries)
        most, added = _MOST_BEHIND if self._separators[0].known else _MOST, 0
        for k in np.argsort(values, kind="stable"):
            if values[k] >= -_MISSING or added == most:
                break
            one, old = self._separators[int(k)], active.get(int(k), Corners(frozenset(), frozenset()))
            if k in ends and one.slack(ends[int(k)]) > -values[k] / 2:
                continue
            # A plane of the program that is not the one between the closest points may cut any corner without a row.
            for new in (one.corners(model), one.every_corner):
                if not (new.a <= old.a and new.b <= old.b):
                    active[int(k)] = Corners(old.a | new.a, old.b | new.b)
                    added += 1
                    break
        if not added:
            return self
        shared = self._lifted, (self._distances, self._own)
        return type(self)(self.name, self._separators, self._words, active, *shared)

    def slack(self, auxiliaries: Array) -> float:
        """See :class:`Constraint`; the largest of a pair."""
        ends = self._ends(auxiliaries)
        return max((self._separators[k].slack(own) for k, own in ends.items()), default=0.0)

    def _ends(self, auxiliaries: Array) -> dict[int, Array]:
        """Return the unknowns of each pair; none of those that came in after the program was built."""
        counts = [one.count for _, one, _ in self._program]
        parts = np.split(auxiliaries, np.cumsum(counts)[:-1]) if counts else []
        return {k: own for k, own in zip(self.active, parts, strict=True) if own.size}

    # ---- lifted form ------------------------------------------------------------------------------------------

    @property
    def _program(self) -> list[tuple[int, SeparatingPlane, Corners]]:
        return [(k, self._separators[k], corners) for k, corners in self.active.items()]

    def _own_plane(self, k: int) -> slice:
        """Where the plane of a pair with a half-space is among the parameters; empty for another pair."""
        first = self._first_parameter.get(id(self._separators[k].b))
        return slice(0) if first is None else slice(first, first + 4)

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """See :class:`Constraint`; a pair keeps its equations while others, and more corners, come in."""
        lifted = self._lifted.setdefault(tree, {})
        for k, one, corners in self._program:
            before, pair = lifted.get(k) or (None, one.lift(tree, f"{self.name}{k}", parameters[self._own_plane(k)]))
            if corners != before:
                lifted[k] = corners, replace(pair, sides=one.sides(pair.variables, corners))
        return LiftedRows.joined([lifted[k][1] for k in self.active])

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
        near = np.flatnonzero(self._distances.within(model, _ROWS, self._own) < _ROWS)
        own = self._ends(auxiliaries) if near.size else {}
        parts = [self._separators[int(k)].linearize(model, own.get(int(k))) for k in near]
        return Linearization.joined(parts, model.model.nv)
