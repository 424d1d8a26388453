"""Smooth curves through postures on the constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from impact_posture.path.path_search import even
from impact_posture.path.path_space import STEP, PathSpace
from impact_posture.path.row_interpolation import Moment
from impact_posture.posture.manifold.feasible_start import Projector
from impact_posture.system.arrays import Array

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

# Largest permitted distance of the curve from the constraints, measured in the tangent space.
DEVIATION = 1e-5
# Largest number of times that the number of knots is doubled.  At a corner, each doubling halves the deviation.
_DOUBLINGS = 7
# Number of knots of the projected spline for each knot of the original spline.  Eight times as many knots divide the
# deviation by about 8⁴.
_FINER = 8
# Step of central differences along the curve, whose length is 1.
_STEP = 1e-5
# A knot is a corner if the second derivative of the spline there exceeds this multiple of the median over the knots.
_SHARP = 5.0
# Number of parts into which the check of limits divides the interval between two knots next to a corner.
_AT_CORNERS = 8
# Number of parts into which the check of limits divides every other interval between two knots.
_BETWEEN = 2


class PathCurve:
    """The cubic spline ``q₀ ⊕ z(s)``, ``0 ≤ s ≤ 1``, through two or more postures, projected onto the equalities.

    The projected curve is as smooth as the spline.  The curve is not projected onto inequalities and joint limits,
    because its velocity would jump where they become active.

    ``s`` contains the values of the parameter at the postures, evenly spaced, shape (n,).  ``z`` contains the tangent
    coordinates of the postures at the first posture, shape (n, nv).  The argument ``ends`` contains the velocity
    ``dq/ds`` at the first and the last posture, shape (nv,) each; with ``None``, the spline chooses this velocity.
    The attribute ``ends`` contains the same as boundary conditions of a ``CubicSpline`` in ``z``.
    """

    def __init__(
        self, space: PathSpace, postures: Sequence[Array], ends: tuple[Array | None, Array | None] = (None, None)
    ) -> None:
        from scipy.interpolate import CubicSpline

        self._space, self._start = space, postures[0]
        self.s = np.linspace(0.0, 1.0, len(postures))
        z = np.array([space.difference(self._start, q) for q in postures])
        for slot in space.projector.chart.slots:
            # A continuous joint may turn more than once.
            if slot.kind.family == "continuous":
                z[:, slot.v] = np.unwrap(z[:, slot.v], axis=0)
        self.z = z
        self.ends = tuple(
            "not-a-knot" if v is None else (1, pin.dDifference(space.model, self._start, q, pin.ARG1) @ v)
            for v, q in zip(ends, (postures[0], postures[-1]), strict=True)
        )
        self.spline = CubicSpline(self.s, z, bc_type=self.ends)

    @property
    def corners(self) -> Array:
        """Whether the curve turns sharply between each knot and the next, shape (n − 1,)."""
        bend = np.abs(self.spline(self.s, 2)).max(axis=1)
        return np.asarray(np.maximum(bend[1:], bend[:-1]) > _SHARP * np.median(bend))

    @property
    def places(self) -> Array:
        """Values of ``s`` at which limits are checked: knots and values between knots, closer together at corners."""
        parts = [
            np.linspace(a, b, _AT_CORNERS if corner else _BETWEEN, endpoint=False)
            for (a, b), corner in zip(pairwise(self.s), self.corners, strict=True)
        ]
        return np.concatenate([*parts, [1.0]])

    def at(self, z: Array) -> Array:
        """Return the posture ``q₀ ⊕ z``, shape (nq,)."""
        return np.asarray(pin.integrate(self._space.model, self._start, z))

    def moment(self, s: float) -> Moment:
        """Return ``q(s)``, ``ν = dq/ds`` in the tangent space at ``q``, and ``dν/ds``."""
        model, (z, dz, ddz) = self._space.model, (self._projected(s, order) for order in range(3))
        ahead, turn, behind = (pin.dIntegrate(model, self._start, z + x * dz, pin.ARG1) for x in (_STEP, 0.0, -_STEP))
        return self.at(z), turn @ dz, turn @ ddz + (ahead - behind) @ dz / (2 * _STEP)

    @cached_property
    def _projected(self) -> CubicSpline:
        """Spline through postures of :attr:`spline` after their projection onto the equalities."""
        from scipy.interpolate import CubicSpline

        problem, s = self._space.problem, np.linspace(0.0, 1.0, _FINER * (len(self.s) - 1) + 1)
        free = np.full(len(problem.lower), np.inf)
        equalities = tuple(c for c in problem.constraints if c.equality)
        projector = Projector(replace(problem, constraints=equalities, lower=-free, upper=free))
        z = self.spline(s)
        for row in z:
            q = self.at(row)
            row += self._space.difference(self._start, projector.project(q).q) - self._space.difference(
                self._start, q
            )
        return CubicSpline(s, z, bc_type=self.ends)

    def deviation(self) -> float:
        """Return the largest tangent distance of the curve from the constraints; infinite if a posture is not valid.

        The search stops at the first distance above ``DEVIATION``, because then the curve needs more knots anyway.
        Between two checked postures, no frame moves more than ``CHECK_DISTANCE``.
        """
        worst, before = 0.0, self.at(self.z[0])
        # The knots themselves are on the constraints.
        parts = max(2, self._space.checks(np.abs(np.diff(self.z, axis=0)).max(axis=0)))
        for s in np.linspace(0.0, 1.0, parts * (len(self.s) - 1) + 1):
            off = self.at(self.spline(float(s)))
            q = self._space.pulled(off)
            if q is None or self._space.size(self._space.difference(before, q)) > 1:
                return float("inf")
            worst, before = max(worst, self._space.distance(off, q)), q
            if worst > DEVIATION:
                break
        return worst


def fitted_curve(
    space: PathSpace,
    postures: Sequence[Array],
    sizes: Sequence[float] | None = None,
    end: Array | None = None,
    least: int = 5,
) -> PathCurve | None:
    """Return a curve through a path, with enough knots to stay on the constraints; ``None`` if that fails.

    ``s`` is proportional to the sum of the ``sizes`` of the steps between postures (default: their tangent lengths).
    ``end`` is the velocity ``dq/ds`` at the end, as in :class:`PathCurve`, and ``least`` the least number of knots.
    """
    count = max(least, int(np.ceil(space.length(postures) / (2 * STEP))) + 1)
    for _ in range(_DOUBLINGS + 1):
        curve = PathCurve(space, even(space, postures, count, sizes), (None, end))
        if curve.deviation() <= DEVIATION:
            return curve
        count = 2 * count - 1
    return None
