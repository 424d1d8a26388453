"""Spatial algebra on CasADi expressions, in Pinocchio's order: linear part first.

A motion ``[v; w]`` and a force ``[f; m]`` are 6-vectors of ``SX``.  ``R`` and ``p`` place a child frame in its
parent: ``x_parent = R x_child + p``.  Structural zeros are kept, so that CasADi never multiplies by a constant zero.
"""

from __future__ import annotations

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
    """``[p]×``, shape (3, 3)."""
    return ca.sparsify(ca.skew(ca.densify(p)))


def cross(a: ca.SX, b: ca.SX) -> ca.SX:
    """``a × b`` for two 3-vectors."""
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
    """``motion ×* force = [w × f; w × m + v × f]`` (Featherstone 2008, eq. 2.32)."""
    linear, angular = motion[:3], motion[3:]
    return ca.vertcat(cross(angular, force[:3]), cross(angular, force[3:]) + cross(linear, force[:3]))


def inertia_to_parent(R: ca.SX, p: ca.SX, inertia: ca.SX) -> ca.SX:
    """Congruence of a symmetric 6×6 (articulated) inertia from the child to the parent frame."""
    A = R @ inertia[:3, :3] @ R.T
    B = R @ inertia[:3, 3:] @ R.T
    D = R @ inertia[3:, 3:] @ R.T
    P = skew(p)
    PB = P @ B
    B_parent = B - A @ P
    D_parent = D + PB + PB.T - P @ A @ P
    return symmetric(ca.blockcat([[A, B_parent], [B_parent.T, D_parent]]))


def symmetric(matrix: ca.SX) -> ca.SX:
    """Copy the upper triangle onto the lower: equal in value, and half of the expressions never get computed."""
    return ca.triu2symm(ca.triu(matrix))


def ldl_solve(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """Solve ``matrix x = rhs`` for a small symmetric positive definite matrix by ``LDLᵀ``, without pivots."""
    n = matrix.shape[0]
    L = [[ca.SX(0)] * n for _ in range(n)]
    d = [ca.SX(0)] * n
    inverse = [ca.SX(0)] * n
    for j in range(n):
        d[j] = matrix[j, j] - sum((L[j][k] * L[j][k] * d[k] for k in range(j)), ca.SX(0))
        inverse[j] = 1 / d[j]
        for i in range(j + 1, n):
            dot = sum((L[i][k] * L[j][k] * d[k] for k in range(j)), ca.SX(0))
            L[i][j] = (matrix[i, j] - dot) * inverse[j]
    columns = []
    for c in range(rhs.shape[1]):
        y = [rhs[i, c] for i in range(n)]
        for i in range(n):
            for k in range(i):
                y[i] = y[i] - L[i][k] * y[k]
        x = [y[i] * inverse[i] for i in range(n)]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                x[i] = x[i] - L[k][i] * x[k]
        columns.append(ca.vertcat(*x))
    return ca.horzcat(*columns)


def quaternion_product(a: ca.SX, b: ca.SX) -> ca.SX:
    """Hamilton product of two quaternions in ``x y z w`` order."""
    va, wa, vb, wb = a[:3], a[3], b[:3], b[3]
    return ca.vertcat(wa * vb + wb * va + cross(va, vb), wa * wb - ca.dot(va, vb))


def quaternion_matrix(q: ca.SX) -> ca.SX:
    """Rotation matrix of a unit quaternion in ``x y z w`` order; quadratic in its entries."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
