"""The constraint that the distances between links, surface, ground and obstacles exceed the clearance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.quantities.lifted_form import Guess
from impact_posture.posture.constraints.constraint import Constraint, LiftedRows, Linearization, digest
from impact_posture.posture.constraints.pair_distances import PairDistances
from impact_posture.posture.constraints.separating_plane import EQUATIONS, Corners, SeparatingPlane
from impact_posture.system.arrays import Array

# Distances minus the clearance are computed exactly if they are below this value, m; larger distances are replaced by
# lower bounds.
_NEAR = 0.01
# The certificate contains the rows of a pair if its distance minus the clearance is below this value, m.
_ROWS = 1e-3
# A pair is added to the program if it violates its clearance by more than this value, m.  The tolerance of the
# certificate is twice this value.
_MISSING = 5e-9
# Largest number of pairs that one posture adds to the program.  Pairs with the deepest penetration come first.
# ``_MOST`` is for pairs of links, and ``_MOST_BEHIND`` for pairs of a link and a plane.  Links behind a plane are
# mostly neighbors, so moving the deepest link out also moves the other links.
_MOST, _MOST_BEHIND = 6, 2

_Lifted = WeakKeyDictionary[Tree, dict[int, tuple[Corners, LiftedRows]]]


class Clearance(Constraint):
    """``distance(a, b) − clearance ≥ 0`` for pairs of bodies.

    The program contains only active pairs.  :meth:`grown` adds pairs whose clearance a posture violates.

    Args:
        active: Maps the index of each pair in the program to the corners that have rows in the program.
        lifted: Cache of the expressions of each pair, by kinematic tree and pair index; the constraints that
            :meth:`grown` returns share this cache.
        distances: Distances of all pairs of :class:`Surroundings`, and the indices of the pairs of this constraint.
    """

    projected = False
    grows = True
    by_row = True
    unit = "m"

    def __init__(
        self,
        name: str,
        pairs: Sequence[SeparatingPlane],
        description: str,
        active: Mapping[int, Corners] | None = None,
        lifted: _Lifted | None = None,
        distances: tuple[PairDistances, range] | None = None,
    ) -> None:
        self.name, self._pairs, self._description = name, tuple(pairs), description
        self.active: Mapping[int, Corners] = active or {}
        self._lifted = _Lifted() if lifted is None else lifted
        self.lower, self.upper = np.zeros(len(pairs)), np.full(len(pairs), np.inf)
        self._distances, self._indices = distances or (PairDistances(pairs), range(len(pairs)))
        planes = {id(pair.b): pair.b.plane for pair in pairs if pair.known}
        # The coefficients of known planes are parameters, so one program can be used for different planes.
        self.parameters = np.concatenate([np.zeros(0), *planes.values()])
        self._first_parameter = {body: 4 * index for index, body in enumerate(planes)}

    def describe(self) -> str:
        return self._description

    @property
    def structure(self) -> str:
        content = "".join(f"{self._plane_parameters(k)}{pair.content(corners)}" for k, pair, corners in self._program)
        return f"{super().structure}:{self.parameters.size}:{digest(content)}"

    def row_name(self, row: int) -> str:
        return self._pairs[row].name

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        """Return distances minus the clearance, and their Jacobian.

        A value above 1 cm may be a lower bound with a zero Jacobian.
        """
        values = self._distances.within(model, _NEAR, self._indices)
        jacobian = np.zeros((self.rows, model.model.nv))
        for k in np.flatnonzero(values < _NEAR):
            pair = self._pairs[k]
            normal, (at_a, at_b) = pair.distance(model)[1:]
            jacobian[k] = pair.a.rates(model, normal, at_a[None])[0] - pair.b.rates(model, normal, at_b[None])[0]
        return values, jacobian

    def value(self, model: Numeric) -> Array:
        return self._distances.within(model, 0.0, self._indices)

    def closest(self, model: Numeric) -> tuple[str, float]:
        """Return the name of the closest pair, and its distance minus the clearance, m."""
        bounds, closest = self._distances.bounds(model, self._indices), ("", np.inf)
        for k in np.argsort(bounds, kind="stable"):
            if bounds[k] >= closest[1]:
                break
            distance = self._pairs[int(k)].distance(model)[0]
            if distance < closest[1]:
                closest = self._pairs[int(k)].name, distance
        return closest

    def grown(self, model: Numeric, auxiliaries: Array | None = None) -> Self:
        """Return the constraint with additional rows in the program for violated pairs.

        The rows are for a new pair, or for further corners of a pair.  If the slack of a pair exceeds half of its
        violation, the pair gets no further rows, because the solver violated even the present rows.
        """
        values, active = self.value(model), dict(self.active)
        unknowns = {} if auxiliaries is None else self._unknowns(auxiliaries)
        most, added = _MOST_BEHIND if self._pairs[0].known else _MOST, 0
        for k in np.argsort(values, kind="stable").tolist():
            if values[k] >= -_MISSING or added == most:
                break
            pair, old = self._pairs[k], active.get(k, Corners(frozenset(), frozenset()))
            if k in unknowns and pair.slack(unknowns[k]) > -values[k] / 2:
                continue
            # If the closest corners already have rows, all corners are added.  The plane in the program may differ
            # from the plane between the closest points.  Any corner without a row may then lie on the wrong side of
            # the plane.
            for new in (pair.corners(model), pair.every_corner):
                if not (new.a <= old.a and new.b <= old.b):
                    active[k] = Corners(old.a | new.a, old.b | new.b)
                    added += 1
                    break
        if not added:
            return self
        distances = self._distances, self._indices
        return type(self)(self.name, self._pairs, self._description, active, self._lifted, distances)

    def slack(self, auxiliaries: Array) -> float:
        """Return the largest slack of a pair, m."""
        return max((self._pairs[k].slack(z) for k, z in self._unknowns(auxiliaries).items()), default=0.0)

    def _unknowns(self, auxiliaries: Array) -> dict[int, Array]:
        """Split the auxiliary unknowns by pair, without pairs that were added after the program was built."""
        counts = [pair.count for _, pair, _ in self._program]
        parts = np.split(auxiliaries, np.cumsum(counts)[:-1]) if counts else []
        return {k: z for k, z in zip(self.active, parts, strict=True) if z.size}

    @property
    def _program(self) -> list[tuple[int, SeparatingPlane, Corners]]:
        return [(k, self._pairs[k], corners) for k, corners in self.active.items()]

    def _plane_parameters(self, k: int) -> slice:
        """Return the slice of the parameters with the known plane of pair k; empty if its plane is unknown."""
        first = self._first_parameter.get(id(self._pairs[k].b))
        return slice(0) if first is None else slice(first, first + 4)

    def lift(self, tree: Tree, parameters: ca.SX) -> LiftedRows:
        """Return the equations and inequalities of the active pairs.

        The equations of a pair are built once and reused when pairs or corners are added.
        """
        lifted = self._lifted.setdefault(tree, {})
        for k, pair, corners in self._program:
            known, rows = lifted.get(k) or (
                None,
                pair.lift(tree, f"{self.name}{k}", parameters[self._plane_parameters(k)]),
            )
            if corners != known:
                lifted[k] = corners, replace(rows, sides=pair.sides(rows.variables, corners))
        return LiftedRows.joined([lifted[k][1] for k in self.active])

    @property
    def lifted_bounds(self) -> tuple[Array, Array]:
        equations = np.zeros(EQUATIONS * len(self.active))
        bounds = [pair.bounds(corners) for _, pair, corners in self._program]
        lower, upper = (np.concatenate([equations, *[bound[side] for bound in bounds]]) for side in (0, 1))
        return lower, upper

    @property
    def unknowns(self) -> int:
        return sum(pair.count for _, pair, _ in self._program)

    def guess(self, model: Numeric) -> Guess:
        return Guess.joined([pair.guess(model) for _, pair, _ in self._program])

    def linearize(self, model: Numeric, auxiliaries: Array) -> Linearization:
        """Linearize the rows of all near pairs, including pairs that are not in the program."""
        near = np.flatnonzero(self._distances.within(model, _ROWS, self._indices) < _ROWS).tolist()
        unknowns = self._unknowns(auxiliaries) if near else {}
        parts = [self._pairs[k].linearize(model, unknowns.get(k)) for k in near]
        return Linearization.joined(parts, model.model.nv)


class SpreadClearance(Clearance):
    """Clearance to the surfaces of a strike, for every tilt and shift of the surfaces within the stated limits."""

    at_impact = True
