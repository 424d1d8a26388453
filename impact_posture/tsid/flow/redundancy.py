"""Motions that do not change contacts and tasks, and motions that correct errors of contacts and tasks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.system.arrays import Array

# A direction gets a spring instead of a constraint if its singular value is below this fraction of the largest one.
# Rows of points on one body can be almost dependent.  If such rows were constraints, they would switch on and off
# from posture to posture, and the flow would never rest.
SLACK = 2e-2
# Stiffness of the springs relative to ``H₀``, 1/m²: the energy at an error of 6 mm is about half of ``H₀``.
SPRING = 3e4
# This value is added to the diagonal of the equations in :meth:`Redundancy.back`, which would otherwise be singular
# if the base can move while the joints are at rest.
IDLE = 1e-9


@dataclass(frozen=True)
class Redundancy:
    """Directions that do not change the constraints (null space of ``J = U S Vᵀ``), and a pseudo-inverse of ``J``.

    Attributes:
        basis: Orthonormal basis ``Z`` of the null space, shape (nv, r).
        inverse: Pseudo-inverse ``J⁺`` on the constrained directions, shape (nv, rows).
        springs: ``k JZ`` of nearly dependent constraints, which are springs of stiffness ``k``, shape (rows, r);
            ``None`` without springs.
        stiffness: Stiffness ``k s²`` of the springs along each column of ``Z``, shape (r,), or ``None``.
    """

    basis: Array
    inverse: Array
    springs: Array | None = None
    stiffness: Array | None = None

    @classmethod
    def of(cls, J: Array) -> Redundancy:
        """Return the redundancy of the constraints with the Jacobian ``J``, shape (rows, nv)."""
        rows, nv = J.shape
        if not rows:
            return cls(np.eye(nv), np.zeros((nv, 0)))
        U, s, Vt = np.linalg.svd(J)
        rank = int(np.count_nonzero(s > SLACK * s[0]))
        Z, soft = Vt[rank:].T, s[rank:]
        springs = stiffness = None
        if soft.size:
            springs, stiffness = np.zeros((rows, Z.shape[1])), np.zeros(Z.shape[1])
            springs[:, : soft.size] = U[:, rank : s.size] * (SPRING * soft)
            stiffness[: soft.size] = SPRING * soft**2
        return cls(Z, (Vt[:rank].T / s[:rank]) @ U[:, :rank].T, springs, stiffness)

    def project(self, vector: Array) -> Array:
        """Return the projection of a vector, shape (nv,), onto the null space of the constraints."""
        return np.asarray(self.basis @ (self.basis.T @ vector))

    def back(self, rate: Array, base: int) -> Array:
        """Return the velocity, shape (nv,), that changes the constraints at ``rate`` and moves the joints least.

        ``rate`` has the shape (rows,).  The first ``base`` entries of the velocity belong to the base.
        """
        back, Z = self.inverse @ rate, self.basis
        if base:
            joints = Z[base:]
            square = joints.T @ joints
            square.flat[:: square.shape[0] + 1] += IDLE
            back -= Z @ np.linalg.solve(square, joints.T @ back[base:])
        return np.asarray(back)
