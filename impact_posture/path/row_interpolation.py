"""The motion between the rows of a path: quintic polynomials, as in ``joint_trajectory_controller`` of ROS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.path.time_law import DIGITS
from impact_posture.system.arrays import Array

# Name of this interpolation in files.
INTERPOLATION = "quintic"

# Posture, velocity and acceleration.
Moment = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class RowInterpolation:
    """Motion through rows of positions, velocities and accelerations, by polynomials of degree 5 between the rows.

    The polynomial is the tangent vector from the earlier of the two rows to the posture.  For a joint of one axis,
    the entry of this vector is the change of angle or travel since the earlier row.

    Attributes:
        t: Times of the rows, s, shape (n,).
        q: Postures, shape (n, nq).
        v: Generalized velocities ``ν``, shape (n, nv).
        a: Generalized accelerations ``ν̇``, shape (n, nv).
    """

    model: pin.Model
    t: Array
    q: Array
    v: Array
    a: Array

    def followed_by(self, other: RowInterpolation) -> RowInterpolation:
        """Return this motion and then ``other``, which begins with the last row of this motion."""
        t = np.append(self.t, (self.t[-1] + other.t[1:]).round(DIGITS))
        rows = (np.vstack([getattr(self, key), getattr(other, key)[1:]]) for key in ("q", "v", "a"))
        return RowInterpolation(self.model, t, *rows)

    def coefficients(self, k: int) -> Array:
        """Return the coefficients of ``u``, …, ``u⁵`` between rows ``k`` and ``k + 1``, shape (5, nv).

        The polynomial gives tangent coordinates at row ``k``; ``u`` rises from 0 at row ``k`` to 1 at row ``k + 1``.
        """
        start, end, h = self.q[k], self.q[k + 1], self.t[k + 1] - self.t[k]
        turn = pin.dDifference(self.model, start, end, pin.ARG1)
        # The change of the matrix along the step is ignored, because it is of second order, and zero for joints of
        # one axis.
        v, a = self.v[k] * h, self.a[k] * h**2
        gap = np.array(pin.difference(self.model, start, end)) - v - a / 2
        speed, bend = h * (turn @ self.v[k + 1]) - v - a, h**2 * (turn @ self.a[k + 1]) - a
        high = 10 * gap - 4 * speed + bend / 2, -15 * gap + 7 * speed - bend, 6 * gap - 3 * speed + bend / 2
        return np.array([v, a / 2, *high])

    def at(self, t: float) -> Moment:
        """Return posture, velocity and acceleration at time ``t``, which is limited to the times of the rows."""
        k = int(np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2))
        start, h = self.q[k], self.t[k + 1] - self.t[k]
        u = float(np.clip((t - self.t[k]) / h, 0.0, 1.0))
        c = self.coefficients(k)
        z = u * (c[0] + u * (c[1] + u * (c[2] + u * (c[3] + u * c[4]))))
        dz = c[0] + u * (2 * c[1] + u * (3 * c[2] + u * (4 * c[3] + u * 5 * c[4])))
        ddz = 2 * c[1] + u * (6 * c[2] + u * (12 * c[3] + u * 20 * c[4]))
        back = pin.dIntegrate(self.model, start, z, pin.ARG1)
        return np.array(pin.integrate(self.model, start, z)), back @ dz / h, back @ ddz / h**2
