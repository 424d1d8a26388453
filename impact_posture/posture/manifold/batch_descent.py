"""Descend from many postures at once, on the equalities of a problem and within its joint limits.

Each step is the sum of a quasi-Newton step (BFGS) in the tangent space of the equalities and of a Gauss–Newton step
that returns to the equalities.  Postures that violate the equalities are compared by the Lagrangian ``m − λᵀc``, with
the merit m, the equalities c and the least-squares multipliers λ.  To first order, the Lagrangian is the merit after
the return to the equalities, so a step needs a single evaluation.  When a descent ends, a new descent can begin, so
the batch stays full.  For an arm, a descent takes about 0.3 ms, and a run of IPOPT about 10 ms.  Clearances and loads
have no batch function, so descents ignore them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold, right_inverse, times
from impact_posture.system.arrays import Array

# Largest residual of the equalities, m or rad, with which a descent may begin and end.
_NEAR = 1e-4
# Largest residual of the equalities, m or rad, after an accepted step.
_DRIFT = 0.1
# Largest number of Gauss–Newton steps from a random posture to the equalities.
_PROJECTING = 10
# First and largest trust radius, rad or m.
_FIRST, _LONGEST = 0.3, 0.6
# A descent ends if its trust radius falls below this value, rad or m.
_SHORTEST = 1e-6
# A step is accepted if the merit decreases by at least this fraction of the predicted decrease.
_SUFFICIENT = 1e-4
# Factor that shortens a rejected step.
_SHORTER = 0.3
# A descent ends if the next step would lower the merit by less than this value.
_CONVERGED = 1e-3
# Largest number of steps of a descent.
_STEPS = 80
# Number of times that the active joint limits are chosen anew.
_ACTIVE_SETS = 3
# The Hessian is updated only if the cosine between the step and the change of the gradient exceeds this value.
_CURVED = 1e-3
# Least cosine between the direction of a step and the steepest descent.
_DOWNHILL = 1e-2


@dataclass
class _Rows:
    """Arrays with a row for each posture."""

    def taken(self, rows: NDArray[np.bool_]) -> Self:
        return type(self)(*[getattr(self, field.name)[rows] for field in fields(self)])

    def joined(self, other: Self) -> Self:
        """Return these rows, followed by the rows of ``other``."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return type(self)(*[np.concatenate(pair) for pair in pairs])


@dataclass
class Ends(_Rows):
    """Postures where descents ended, shape (N, nx), with the merit and the tag of each."""

    x: Array
    merit: Array
    tag: NDArray[np.int_]


@dataclass
class _Points(_Rows):
    """Postures, and the values from which the next steps are computed.

    Attributes:
        x: Postures, shape (N, nx).
        merit: Lagrangian ``m − λᵀc``, shape (N,).
        gradient: Gradient along the equalities and the active limits, shape (N, nv).
        tangent: Projection of tangent vectors onto the equalities and the active limits, shape (N, nv, nv).
        back: Gauss–Newton step to the equalities, shape (N, nv).
        residual: Largest violation of an equality, shape (N,).
    """

    x: Array
    merit: Array
    gradient: Array
    tangent: Array
    back: Array
    residual: Array


@dataclass
class _State(_Points):
    """Descents that have not ended, one row for each.

    Attributes:
        direction: Direction of the next step, shape (N, nv).
        hessian: Estimated inverse Hessian, shape (N, nv, nv).
        fresh: Whether the Hessian is the identity matrix, shape (N,).
        radius: Trust radius, shape (N,).
        age: Number of steps, shape (N,).
        tag: Integer that the caller gave to the posture, shape (N,).
    """

    direction: Array
    hessian: Array
    fresh: NDArray[np.bool_]
    radius: Array
    age: NDArray[np.int_]
    tag: NDArray[np.int_]


class BatchDescent:
    """Descents on a manifold.  :meth:`add` begins descents, :meth:`step` continues all.

    Attributes:
        stuck: Tags of the descents that ended at postures that violate the equalities, shape (K,).
    """

    def __init__(self, manifold: ConstraintManifold) -> None:
        self.manifold, self.stuck = manifold, np.zeros(0, dtype=int)
        self._state = self._begin(np.zeros((0, manifold.chart.nx)), np.zeros(0, dtype=int))

    @property
    def active(self) -> int:
        """Number of descents that have not ended."""
        return len(self._state.x)

    def add(self, x: Array, tag: NDArray[np.int_]) -> None:
        """Project postures, shape (N, nx), and begin a descent from each posture that reaches the equalities."""
        projected = self.manifold.project(x, _PROJECTING, within=True, tolerance=_NEAR)
        begun = self._begin(projected.x[projected.converged], tag[projected.converged])
        begun = begun.taken(np.isfinite(begun.merit))
        self._state = self._state.joined(begun)

    def step(self) -> Ends:
        """Take a step in each descent, and return the descents that ended at postures that satisfy the equalities."""
        s, manifold = self._state, self.manifold
        s.age += 1
        size = np.linalg.norm(s.direction, axis=1)
        length = np.minimum(1.0, s.radius / np.maximum(size, 1e-300))
        along = length[:, None] * s.direction
        point = self._points(np.clip(manifold.move(s.x, along + s.back), manifold.lower, manifold.upper))
        bound = s.merit + _SUFFICIENT * length * (s.direction * s.gradient).sum(axis=1)
        # If the residual is too large for the first-order estimate, a step that halves the residual may raise the
        # merit.
        returned = (s.residual > _NEAR) & (point.residual < s.residual / 2)
        accepted = np.isfinite(point.merit) & (point.residual <= _DRIFT) & ((point.merit <= bound) | returned)
        grown = np.where(length < 1, np.minimum(2 * s.radius, _LONGEST), s.radius)
        s.radius = np.where(accepted, grown, _SHORTER * length * size)
        # A rejected step also shows how the gradient changes.
        change = np.where(np.isfinite(point.merit)[:, None], point.gradient - s.gradient, 0.0)
        s.hessian, s.fresh = _updated(s.hessian, s.fresh, along, change)
        for field in fields(point):
            getattr(s, field.name)[accepted] = getattr(point, field.name)[accepted]
        self._turn()
        decrease = -(s.direction * s.gradient).sum(axis=1)
        ended = ((decrease < _CONVERGED) & (s.residual <= _NEAR)) | (s.radius < _SHORTEST) | (s.age >= _STEPS)
        self._state, ends = s.taken(~ended), s.taken(ended)
        on = ends.residual <= _NEAR
        self.stuck = np.append(self.stuck, ends.tag[~on])
        return Ends(ends.x, ends.merit, ends.tag).taken(on)

    def _begin(self, x: Array, tag: NDArray[np.int_]) -> _State:
        point, count, nv = self._points(x), len(x), self.manifold.chart.nv
        hessian = np.broadcast_to(np.eye(nv), (count, nv, nv)).copy()
        radius, age = np.full(count, _FIRST), np.zeros(count, dtype=int)
        new = {"direction": -point.gradient, "hessian": hessian, "fresh": radius > 0, "radius": radius, "age": age}
        return _State(**vars(point), **new, tag=tag)

    def _points(self, x: Array) -> _Points:
        at, nv = self.manifold.evaluate(x), self.manifold.chart.nv
        free, rows = np.ones(at.gradient.shape, dtype=bool), np.arange(len(x))
        jacobian, rest = np.empty_like(at.jacobian), np.empty_like(at.gradient)
        inverse, multipliers = np.empty((len(x), nv, jacobian.shape[1])), np.empty(at.equalities.shape)
        for _ in range(_ACTIVE_SETS):
            jacobian[rows] = np.where(free[rows, None, :], at.jacobian[rows], 0.0)
            inverse[rows] = right_inverse(jacobian[rows])
            # Gradient minus its component that multipliers of the equalities balance.  At a limit, the sign of this
            # difference shows whether the limit is active.
            multipliers[rows] = times(inverse[rows].transpose(0, 2, 1), at.gradient[rows])
            rest[rows] = at.gradient[rows] - times(at.jacobian[rows].transpose(0, 2, 1), multipliers[rows])
            before, free = free, ~self.manifold.blocked(x, -rest)
            rows = np.flatnonzero((free != before).any(axis=1))
            if not rows.size:
                break
        tangent = before[:, :, None] * np.eye(nv) - inverse @ jacobian
        back = self.manifold.back(x, at.equalities, jacobian, inverse)
        residual = np.abs(at.equalities).max(axis=1, initial=0.0)
        merit = at.merit - (multipliers * at.equalities).sum(axis=1)
        return _Points(x, merit, np.where(before, rest, 0.0), tangent, back, residual)

    def _turn(self) -> None:
        s = self._state
        s.direction = -times(s.tangent, times(s.hessian, s.gradient))
        slope = (s.direction * s.gradient).sum(axis=1)
        sizes = np.linalg.norm(s.direction, axis=1) * np.linalg.norm(s.gradient, axis=1)
        uphill = slope > -_DOWNHILL * sizes
        s.hessian[uphill], s.fresh = np.eye(self.manifold.chart.nv), s.fresh | uphill
        s.direction[uphill] = -s.gradient[uphill]


def _updated(hessian: Array, fresh: NDArray[np.bool_], step: Array, change: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverse Hessians after a BFGS update, and which of them are still the identity matrix."""
    curvature, squared = (step * change).sum(axis=1), (change * change).sum(axis=1)
    usable = curvature > _CURVED * np.sqrt((step * step).sum(axis=1) * squared)
    first = usable & fresh
    hessian[first] = (curvature[first] / squared[first])[:, None, None] * np.eye(step.shape[1])
    share = np.where(usable, 1 / np.where(usable, curvature, 1.0), 0.0)
    turned = times(hessian, change)
    half = share * (1 + share * (change * turned).sum(axis=1)) / 2
    outer = (half[:, None] * step - share[:, None] * turned)[:, :, None] * step[:, None, :]
    return hessian + outer + outer.transpose(0, 2, 1), fresh & ~usable
