"""Spatial algebra on CasADi expressions, with the linear part first as in Pinocchio.

A motion ``[v; w]`` and a force ``[f; m]`` are 6-vectors of ``SX``.  ``R`` and ``p`` place a child frame in its
parent by ``x_parent = R x_child + p``.  Structural zeros stay, so that CasADi never multiplies by a constant zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike


def constant(value: ArrayLike) -> ca.SX:
    """Turn numbers into ``SX`` with exact zeros as structural zeros and rounding dust removed."""
    array = np.array(value, dtype=float)
    for nice in (-1.0, 0.0, 1.0):
        array[np.abs(array - nice) < 1e-15] = nice
    return ca.sparsify(ca.SX(array))


def skew(p: ca.SX) -> ca.SX:
    """Return ``[p]×``, shape (3, 3)."""
    return ca.sparsify(ca.skew(ca.densify(p)))


def cross(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return ``a × b`` of two 3-vectors."""
    return ca.cross(ca.densify(a), ca.densify(b))


def motion_to_child(R: ca.SX, p: ca.SX, motion: ca.SX) -> ca.SX:
    """Express a parent-frame motion in the child frame: ``w = Rᵀw, v = Rᵀ(v + w × p)``."""
    linear, angular = motion[:3], motion[3:]
    return ca.vertcat(R.T @ (linear + cross(angular, p)), R.T @ angular)


def force_to_parent(R: ca.SX, p: ca.SX, force: ca.SX) -> ca.SX:
    """Express a child-frame force in the parent frame: ``f = R f, m = R m + p × R f``."""
    linear = R @ force[:3]
    return ca.vertcat(linear, R @ force[3:] + cross(p, linear))


def motion_cross_force(motion: ca.SX, force: ca.SX) -> ca.SX:
    """Return ``motion ×* force = [w × f; w × m + v × f]`` (Featherstone 2008, eq. 2.32)."""
    linear, angular = motion[:3], motion[3:]
    return ca.vertcat(cross(angular, force[:3]), cross(angular, force[3:]) + cross(linear, force[:3]))


@dataclass(frozen=True)
class Spin:
    """Rotation about the coordinate ``axis`` 0, 1 or 2, with the cosine and sine of its angle.

    ``sense`` is −1 where the axis of the joint points the other way; the sine contains it already.
    """

    axis: int
    cosine: ca.SX
    sine: ca.SX
    sense: float = 1.0

    @cached_property
    def double(self) -> tuple[ca.SX, ca.SX]:
        """Cosine and sine of twice the angle, by which a symmetric matrix turns."""
        return (self.cosine - self.sine) * (self.cosine + self.sine), 2 * self.sine * self.cosine

    def matrix(self, M: ca.SX) -> ca.SX:
        """Return ``R M Rᵀ`` of a 3×3 matrix by plane rotations, with 16 products, or 12 if ``M`` is symmetric."""
        i, j, k = (self.axis + 1) % 3, (self.axis + 2) % 3, self.axis
        c2, s2 = self.double
        mean, half = (M[i, i] + M[j, j]) / 2, (M[i, i] - M[j, j]) / 2
        even, odd = (M[i, j] + M[j, i]) / 2, (M[i, j] - M[j, i]) / 2
        turned, mixed = half * c2 - even * s2, half * s2 + even * c2
        out = ca.SX(3, 3)
        out[i, i], out[j, j], out[i, j], out[j, i] = mean + turned, mean - turned, mixed + odd, mixed - odd
        out[i, k], out[j, k] = self._plane(M[i, k], M[j, k])
        out[k, i], out[k, j] = self._plane(M[k, i], M[k, j])
        out[k, k] = M[k, k]
        return ca.sparsify(out)

    def rate(self, inertia: ca.SX) -> ca.SX:
        """Return the symmetric ``K = (S×)ᵀ I + I (S×)`` of a 6×6 inertia ``I`` and the motion ``S`` of the axis."""
        i, j, k = (self.axis + 1) % 3, (self.axis + 2) % 3, self.axis
        out = ca.SX(6, 6)
        for rows, columns in ((0, 0), (0, 3), (3, 3)):
            M = inertia[rows : rows + 3, columns : columns + 3]
            sum_, difference = M[i, j] + M[j, i], M[j, j] - M[i, i]
            K = ca.SX(3, 3)
            K[i, i], K[j, j] = sum_, -sum_
            K[i, j], K[j, i] = difference, difference
            K[i, k], K[j, k], K[k, i], K[k, j] = M[j, k], -M[i, k], M[k, j], -M[k, i]
            out[rows : rows + 3, columns : columns + 3] = self.sense * K
        return symmetric(ca.sparsify(out))

    def _plane(self, x: ca.SX, y: ca.SX) -> tuple[ca.SX, ca.SX]:
        return self.cosine * x - self.sine * y, self.sine * x + self.cosine * y


def rotate_inertia(inertia: ca.SX, R: ca.SX, spin: Spin | None) -> ca.SX:
    """Rotate a symmetric 6×6 inertia by ``spin`` and then by ``R``; by ``R`` alone without a spin."""
    blocks = [symmetric(inertia[:3, :3]), inertia[:3, 3:], symmetric(inertia[3:, 3:])]
    if spin is not None:
        blocks = [spin.matrix(block) for block in blocks]
    if not (R.is_constant() and np.array_equal(np.array(ca.DM(R)), np.eye(3))):
        blocks = [R @ block @ R.T for block in blocks]
    A, B, D = blocks
    return symmetric(ca.blockcat([[A, B], [B.T, D]]))


def shift_inertia(inertia: ca.SX, p: ca.SX) -> ca.SX:
    """Move a symmetric 6×6 inertia to the origin at ``−p`` by ``B' = B − A[p]×, D' = D + [p]×B + B'ᵀ[p]×ᵀ``."""
    P = skew(p)
    A, B, D = inertia[:3, :3], inertia[:3, 3:], inertia[3:, 3:]
    shifted = B - A @ P
    # ([p]× B')ᵀ = B'ᵀ [p]×ᵀ
    return symmetric(ca.blockcat([[A, shifted], [shifted.T, D + P @ B + (P @ shifted).T]]))


def symmetric(matrix: ca.SX) -> ca.SX:
    """Copy the upper triangle onto the lower, so that half of the expressions are never computed."""
    return ca.triu2symm(ca.triu(matrix))


def ldl_solve(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """Solve ``matrix x = rhs`` for a small symmetric positive definite matrix by ``LDLᵀ``, without pivots."""
    D, LT, order = ca.ldl(ca.densify(matrix), False)
    found: ca.SX = ca.ldl_solve(ca.densify(rhs), D, LT, order)
    return found


def quaternion_product(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the Hamilton product of two quaternions in ``x y z w`` order."""
    va, wa, vb, wb = a[:3], a[3], b[:3], b[3]
    return ca.vertcat(wa * vb + wb * va + cross(va, vb), wa * wb - ca.dot(va, vb))


def quaternion_matrix(q: ca.SX) -> ca.SX:
    """Return the rotation matrix of a unit quaternion in ``x y z w`` order; it is quadratic in its entries."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
