"""Descend from many postures at once, on the equalities of a problem and within its joint limits.

Each posture takes quasi-Newton steps (BFGS) in the tangent space of the equalities.  After each step, Gauss–Newton
steps return it to the equalities.  The batch stays full, because a new descent can begin when another ends.  For an
arm, a descent takes about 1 ms, and a run of IPOPT about 10 ms.  Clearances and loads have no batch function, so
descents ignore them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold, right_inverse, times
from impact_posture.system.arrays import Array

# Residual (m, rad) below which a posture satisfies the equalities, and the residual up to which a step is accepted.
_SATISFIED, _DRIFT = 1e-6, 1e-4
# Number of Gauss–Newton steps from a drawn posture, and after a step of a descent.
_PROJECTING, _RETURNING = 15, 2
# Longest step (rad, m), and the step below which a descent cannot continue.
_LONGEST, _SHORTEST = 0.6, 1e-6
# Share of the predicted decrease that a step must reach, and the factor that shortens a rejected step.
_SUFFICIENT, _SHORTER = 1e-4, 0.3
# A descent ends if the next step would lower the merit by less than this, or after this number of steps.
_CONVERGED, _STEPS = 1e-3, 80
# Number of times that the active joint limits are chosen anew.
_ACTIVE_SETS = 3
# Least cosine between step and change of the gradient for an update, and between direction and steepest descent.
_CURVED, _DOWNHILL = 1e-3, 1e-2


@dataclass
class Ends:
    """Postures where descents ended, shape (N, nx), with the merit and the tag of each."""

    x: Array
    merit: Array
    tag: NDArray[np.int_]

    def taken(self, rows: NDArray[np.bool_]) -> Self:
        """Return the rows of a mask."""
        return type(self)(*[getattr(self, field.name)[rows] for field in fields(self)])

    def joined(self, other: Self) -> Self:
        """Return the rows of both."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return type(self)(*[np.concatenate(pair) for pair in pairs])


@dataclass
class _State(Ends):
    """Descents under way: one row for each.

    Attributes:
        x: Postures, shape (N, nx).
        merit: Value of :meth:`ConstraintManifold.merit`, shape (N,).
        tag: Integer that the caller gave to the posture, shape (N,).
        gradient: Gradient of the merit along the manifold and the limits, shape (N, nv).
        direction: Direction of the next step, shape (N, nv).
        hessian: Estimated inverse Hessian, shape (N, nv, nv).
        fresh: Whether the Hessian is the identity matrix, shape (N,).
        length: Share of the direction to try, shape (N,).
        age: Number of steps, shape (N,).
    """

    gradient: Array
    direction: Array
    hessian: Array
    fresh: NDArray[np.bool_]
    length: Array
    age: NDArray[np.int_]


class BatchDescent:
    """Descents on a manifold.  :meth:`add` begins descents, :meth:`step` continues all."""

    def __init__(self, manifold: ConstraintManifold) -> None:
        self.manifold = manifold
        self._state = self._begin(np.zeros((0, manifold.chart.nx)), np.zeros(0, dtype=int))

    @property
    def active(self) -> int:
        """Number of descents under way."""
        return len(self._state.x)

    def add(self, x: Array, tag: NDArray[np.int_]) -> int:
        """Project postures, shape (N, nx), and begin a descent from each that reaches the equalities.

        Return the number of descents that began.
        """
        projected = self.manifold.project(x, _PROJECTING, within=True, tolerance=_SATISFIED)
        begun = self._begin(projected.x[projected.converged], tag[projected.converged])
        begun = begun.taken(np.isfinite(begun.merit))
        self._state = self._state.joined(begun)
        return len(begun.x)

    def step(self) -> Ends:
        """Take a step in each descent, and return the descents that ended."""
        s, manifold = self._state, self.manifold
        s.age += 1
        size = np.linalg.norm(s.direction, axis=1)
        length = np.minimum(s.length, _LONGEST / np.maximum(size, 1e-300))
        moved = length[:, None] * s.direction
        to = manifold.project(manifold.move(s.x, moved), _RETURNING, within=True, tolerance=_SATISFIED)
        merit, gradient = manifold.merit(to.x)
        bound = s.merit + _SUFFICIENT * length * (s.direction * s.gradient).sum(axis=1)
        accepted = np.isfinite(merit) & (to.residual <= _DRIFT) & (merit <= bound)
        s.length = np.where(accepted, 1.0, length * _SHORTER)
        stuck = ~accepted & (length * size < _SHORTEST)
        if accepted.any():
            self._accept(accepted, to.x, merit, gradient, to.jacobian, moved)
        decrease = -(s.direction * s.gradient).sum(axis=1)
        ended = (decrease < _CONVERGED) | stuck | (s.age >= _STEPS)
        self._state = s.taken(~ended)
        return Ends(s.x[ended], s.merit[ended], s.tag[ended])

    def _begin(self, x: Array, tag: NDArray[np.int_]) -> _State:
        merit, gradient = self.manifold.merit(x)
        along = _Along(self.manifold, x, self.manifold.equalities(x)[1], gradient).gradient
        count, nv = gradient.shape
        hessian = np.broadcast_to(np.eye(nv), (count, nv, nv)).copy()
        ones = np.ones(count)
        return _State(x, merit, tag, along, -along, hessian, ones > 0, ones, np.zeros(count, dtype=int))

    def _accept(
        self, rows: NDArray[np.bool_], x: Array, merit: Array, gradient: Array, jacobian: Array, moved: Array
    ) -> None:
        """Move the descents of a mask to their new postures, and choose their next directions."""
        s, identity = self._state, np.eye(self.manifold.chart.nv)
        along = _Along(self.manifold, x[rows], jacobian[rows], gradient[rows])
        hessian, fresh = _updated(s.hessian[rows], s.fresh[rows], moved[rows], along.gradient - s.gradient[rows])
        direction = along.project(-times(hessian, along.gradient))
        slope = (direction * along.gradient).sum(axis=1)
        sizes = np.linalg.norm(direction, axis=1) * np.linalg.norm(along.gradient, axis=1)
        uphill = slope > -_DOWNHILL * sizes
        hessian[uphill], fresh = identity, fresh | uphill
        direction = np.where(uphill[:, None], -along.gradient, direction)
        s.x[rows], s.merit[rows], s.gradient[rows] = x[rows], merit[rows], along.gradient
        s.hessian[rows], s.fresh[rows], s.direction[rows] = hessian, fresh, direction


class _Along:
    """Tangent vectors along the equalities and the active joint limits; ``gradient`` is the projected gradient."""

    def __init__(self, manifold: ConstraintManifold, x: Array, jacobian: Array, gradient: Array) -> None:
        free = np.ones(gradient.shape, dtype=bool)
        for _ in range(_ACTIVE_SETS):
            self._free = free
            self._jacobian = np.where(self._free[:, None, :], jacobian, 0.0)
            self._inverse = right_inverse(self._jacobian)
            # The gradient minus the forces of the equalities: at a limit, its sign says whether the limit is active.
            multipliers = times(self._inverse.transpose(0, 2, 1), gradient)
            rest = gradient - times(jacobian.transpose(0, 2, 1), multipliers)
            self.gradient = np.where(self._free, rest, 0.0)
            free = ~manifold.blocked(x, -rest)
            if (free == self._free).all():
                break

    def project(self, v: Array) -> Array:
        """Return the parts of tangent vectors, shape (N, nv), along the equalities and limits."""
        v = np.where(self._free, v, 0.0)
        return np.asarray(v - times(self._inverse, times(self._jacobian, v)))


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
