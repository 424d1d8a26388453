"""Motions that contacts and tasks leave free, and motions that lead back to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.system.arrays import Array

# Directions with a smaller singular value, relative to the largest, are springs and not constraints.  The rows of
# points on one body can be almost dependent: held exactly in one posture and free in the next, they would never let a
# flow rest.
_SOFT = 2e-2
# Stiffness of these springs relative to ``H₀``, 1/m²: an error of 6 mm costs half of ``H₀``.
_STIFFNESS = 3e4
# Small weight of the base in a motion that the joints do not determine.
_IDLE = 1e-9


@dataclass(frozen=True)
class Redundancy:
    """Directions that the constraints leave, ``J = U S Vᵀ``, and a pseudo-inverse for the directions that they hold.

    Attributes:
        basis: ``Z``, orthonormal, shape (nv, r).
        inverse: ``J⁺`` of the held directions, shape (nv, rows).
        springs: ``k JZ`` of nearly dependent constraints, shape (rows, r); ``None`` where there are none.
        stiffness: Their stiffness ``k s²`` along each column of ``Z``, shape (r,), or ``None``.
    """

    basis: Array
    inverse: Array
    springs: Array | None = None
    stiffness: Array | None = None

    @classmethod
    def of(cls, J: Array) -> Redundancy:
        """Decompose ``J``, shape (rows, nv)."""
        rows, nv = J.shape
        if not rows:
            return cls(np.eye(nv), np.zeros((nv, 0)))
        U, s, Vt = np.linalg.svd(J)
        rank = int(np.count_nonzero(s > _SOFT * s[0]))
        Z, soft = Vt[rank:].T, s[rank:]
        springs = stiffness = None
        if soft.size:
            springs, stiffness = np.zeros((rows, Z.shape[1])), np.zeros(Z.shape[1])
            springs[:, : soft.size] = U[:, rank : s.size] * (_STIFFNESS * soft)
            stiffness[: soft.size] = _STIFFNESS * soft**2
        return cls(Z, (Vt[:rank].T / s[:rank]) @ U[:, :rank].T, springs, stiffness)

    def project(self, vector: Array) -> Array:
        """Return the part of a vector, shape (nv,), that stays on the constraints."""
        return np.asarray(self.basis @ (self.basis.T @ vector))

    def back(self, rate: Array, base: int) -> Array:
        """Return a motion, shape (nv,), that changes the constraints at a rate, shape (rows,).

        Of all such motions, it moves the first ``base`` entries and spares the joints.
        """
        back, Z = self.inverse @ rate, self.basis
        if base:
            joints = Z[base:]
            square = joints.T @ joints
            square.flat[:: square.shape[0] + 1] += _IDLE
            back -= Z @ np.linalg.solve(square, joints.T @ back[base:])
        return np.asarray(back)
