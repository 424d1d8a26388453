"""One time step with unilateral contacts and exact Coulomb friction.

Let ``p`` be the impulses of the contacts in this step, ``W`` their mobility, and ``c`` the velocities of the contact
points without ``p``.  The axes of each contact are two tangents and the normal.  A normal contact is a spring with
``p_n = max(0, (d − u_n)/s)``, where ``u = Wp + c`` is the velocity at the end of the step.  A contact that sticks has
``u_t = 0``; a contact that slides has ``p_t = −μ p_n u_t/‖u_t‖``.  The step is solved by a semi-smooth Newton method
(Alart and Curnier, A Mixed Formulation for Frictional Contact Problems Prone to Newton Like Solution Methods, 1991).
"""

from __future__ import annotations

import numpy as np

from docs.studies.core import Vector

# Compliance of a sticking contact along its tangents (creep), as a share of the mobility of the contact.  The creep
# makes the forces unique if the corners of a sole constrain more directions than the sole has degrees of freedom.
_CREEP = 1e-4
# Relative error of a solved step.
_TOLERANCE = 1e-9
# Number of Newton steps after which a step counts as unsolved.
_NEWTON = 30


class CoulombStep:
    """The conditions of one time step.

    Attributes:
        R: Mobility, plus the compliance of the springs and of the creep, shape (3m, 3m).
        w: Velocities of the contact points for ``p = 0``, less ``d``, shape (3m,).
        friction: Friction coefficients, shape (m,).
    """

    def __init__(self, W: Vector, c: Vector, s: Vector, d: Vector, friction: Vector) -> None:
        self.friction = friction
        self.w, self.R = c.copy(), W.copy()
        self.w[2::3] -= d
        diagonal = np.einsum("ii->i", self.R)
        across = (diagonal[0::3] + diagonal[1::3]) / 2
        diagonal[0::3] += _CREEP * across
        diagonal[1::3] += _CREEP * across
        diagonal[2::3] += s
        # Step sizes of the iteration: impulse per velocity.
        self.rho = np.empty_like(c)
        self.rho[0::3] = self.rho[1::3] = 1 / np.maximum(across, 1e-12 * diagonal[2::3])
        self.rho[2::3] = 1 / diagonal[2::3]

    def solve(self, p: Vector) -> tuple[Vector, bool]:
        """Return the impulses, shape (3m,), and whether they fulfill the conditions; ``p`` is the first guess."""
        best, least = p, np.inf
        for _ in range(_NEWTON):
            F, slope = self._residual(p)
            error = float(np.abs(F).max() / max(np.abs(p).max(), np.abs(self.rho * self.w).max()))
            if error < least:
                best, least = p, error
            if error <= _TOLERANCE:
                break
            p = p - np.linalg.solve(slope, F)
        return best, least <= _TOLERANCE

    def _residual(self, p: Vector) -> tuple[Vector, Vector]:
        """Return how far ``p`` is from its projection onto the conditions, shape (3m,), and the derivative."""
        y = self.rho * (self.R @ p + self.w)
        z = p - y
        slope = self.rho[:, None] * self.R
        F = y.copy()
        for i, mu in enumerate(self.friction):
            t, n = slice(3 * i, 3 * i + 2), 3 * i + 2
            if z[n] <= 0:
                F[3 * i : n + 1] = p[3 * i : n + 1]
                slope[3 * i : n + 1] = 0.0
                slope[range(3 * i, n + 1), range(3 * i, n + 1)] = 1.0
                continue
            radius, size = mu * max(p[n], 0.0), float(np.hypot(*z[t]))
            if size <= radius:
                continue
            along = z[t] / size
            F[t] = p[t] - radius * along
            turn = radius / size * (np.eye(2) - np.outer(along, along))
            rows = turn @ slope[t]
            rows[:, t] += np.eye(2) - turn
            rows[:, n] -= mu * along
            slope[t] = rows
        return F, slope
