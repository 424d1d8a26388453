"""Spatial algebra on CasADi expressions, with the linear part first as in Pinocchio.

A motion ``[v; w]`` and a force ``[f; m]`` are 6-vectors of type ``SX``.  ``R`` and ``p`` are the placement of a child
frame in its parent: ``x_parent = R x_child + p``.  Zeros stay structural zeros, so CasADi never multiplies by zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

P = ParamSpec("P")
Result = TypeVar("Result", ca.SX, tuple[ca.SX, ...])


def template(operation: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate an operation so that its expressions are built only once for each size of arguments.

    The dynamics apply the same operations to every joint, and building expressions in Python is slow.  Later calls
    insert the arguments into the stored expressions, and CasADi simplifies products with zeros and ones.  The
    positional arguments of ``operation`` are ``SX`` matrices, and keyword arguments are options.  ``operation``
    returns a matrix or a tuple of matrices.
    """
    functions: dict[tuple[object, ...], ca.Function] = {}

    @wraps(operation)
    def insert(*arguments: Any, **options: Any) -> Any:
        key = (*[argument.size() for argument in arguments], *options.items())
        if key not in functions:
            symbols = [ca.SX.sym("argument", *argument.size()) for argument in arguments]
            results = operation(*symbols, **options)
            functions[key] = ca.Function("template", symbols, results if isinstance(results, tuple) else [results])
        values = functions[key].call(arguments)
        return values[0] if len(values) == 1 else tuple(values)

    return insert


def rounded(value: ArrayLike) -> NDArray[np.float64]:
    """Return a copy of numbers in which values within 1e-15 of −1, 0 or 1 are rounded to −1, 0 or 1."""
    array = np.array(value, dtype=float)
    nice = np.rint(array)
    near = (np.abs(array - nice) < 1e-15) & (np.abs(nice) <= 1)
    array[near] = nice[near] + 0.0
    return array


def constant(value: ArrayLike) -> ca.SX:
    """Convert rounded numbers (:func:`rounded`) to ``SX``; zeros become structural zeros."""
    return ca.sparsify(ca.SX(rounded(value)))


def skew(p: ca.SX) -> ca.SX:
    """Return the cross-product matrix ``[p]×``, shape (3, 3)."""
    return ca.sparsify(ca.skew(ca.densify(p)))


@template
def cross(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return ``a × b`` of two 3-vectors."""
    return ca.cross(ca.densify(a), ca.densify(b))


@template
def transposed_times(A: ca.SX, b: ca.SX) -> ca.SX:
    """Return the product ``Aᵀ b``."""
    return A.T @ b


@template
def motion_to_child(R: ca.SX, p: ca.SX, motion: ca.SX) -> ca.SX:
    """Express a parent-frame motion in the child frame: ``w = Rᵀw, v = Rᵀ(v + w × p)``."""
    linear, angular = motion[:3], motion[3:]
    return ca.vertcat(R.T @ (linear + cross(angular, p)), R.T @ angular)


@template
def motion_to_parent(R: ca.SX, p: ca.SX, motion: ca.SX) -> ca.SX:
    """Express a child-frame motion in the parent frame: ``w = R w, v = R v − w × p`` with the new ``w``."""
    angular = R @ motion[3:]
    return ca.vertcat(R @ motion[:3] - cross(angular, p), angular)


@template
def force_to_parent(R: ca.SX, p: ca.SX, force: ca.SX) -> ca.SX:
    """Express a child-frame force in the parent frame: ``f = R f, m = R m + p × R f``."""
    linear = R @ force[:3]
    return ca.vertcat(linear, R @ force[3:] + cross(p, linear))


@template
def motion_cross(first: ca.SX, second: ca.SX) -> ca.SX:
    """Return ``first × second = [w₁ × v₂ + v₁ × w₂; w₁ × w₂]`` of two motions (Featherstone 2008, eq. 2.31)."""
    v, w = first[:3], first[3:]
    return ca.vertcat(cross(w, second[:3]) + cross(v, second[3:]), cross(w, second[3:]))


@template
def motion_cross_force(motion: ca.SX, force: ca.SX) -> ca.SX:
    """Return ``motion ×* force = [w × f; w × m + v × f]`` (Featherstone 2008, eq. 2.32)."""
    linear, angular = motion[:3], motion[3:]
    return ca.vertcat(cross(angular, force[:3]), cross(angular, force[3:]) + cross(linear, force[:3]))


@dataclass(frozen=True)
class Spin:
    """Rotation about a coordinate axis, given by the cosine and sine of the angle.

    ``axis`` is 0, 1 or 2.  ``sense`` is −1 if the joint axis points opposite to the coordinate axis, and 1 otherwise.
    ``sine`` is already multiplied by ``sense``.
    """

    axis: int
    cosine: ca.SX
    sine: ca.SX
    sense: float = 1.0


def _turned(M: ca.SX, k: int, cosine: ca.SX, sine: ca.SX) -> ca.SX:
    """Return ``R M Rᵀ`` for a rotation ``R`` about axis ``k`` and a 3×3 matrix ``M``, with few products."""
    i, j = (k + 1) % 3, (k + 2) % 3
    # The symmetric part of the 2×2 block transforms with twice the angle.
    c2, s2 = (cosine - sine) * (cosine + sine), 2 * sine * cosine
    mean, half = (M[i, i] + M[j, j]) / 2, (M[i, i] - M[j, j]) / 2
    even, odd = (M[i, j] + M[j, i]) / 2, (M[i, j] - M[j, i]) / 2
    turned, mixed = half * c2 - even * s2, half * s2 + even * c2
    out = ca.SX(3, 3)
    out[i, i], out[j, j], out[i, j], out[j, i] = mean + turned, mean - turned, mixed + odd, mixed - odd
    out[i, k], out[j, k] = cosine * M[i, k] - sine * M[j, k], sine * M[i, k] + cosine * M[j, k]
    out[k, i], out[k, j] = cosine * M[k, i] - sine * M[k, j], sine * M[k, i] + cosine * M[k, j]
    out[k, k] = M[k, k]
    return out


@template
def spin_power(inertia: ca.SX, x: ca.SX, y: ca.SX, *, axis: int, sense: float) -> ca.SX:
    """Return ``yᵀ K x`` with the symmetric ``K = (S×)ᵀ I + I (S×)`` for a 6×6 inertia ``I`` and a motion ``S``.

    ``S`` is the unit rotation about the coordinate ``axis``, in the negative direction if ``sense`` is −1.
    """
    turn = skew(constant(sense * np.eye(3)[axis]))
    S = ca.diagcat(turn, turn)
    return ca.dot(y, symmetric(S.T @ inertia + inertia @ S) @ x)


@template
def inertia_to_parent(inertia: ca.SX, R: ca.SX, p: ca.SX, *spin: ca.SX, axis: int | None = None) -> ca.SX:
    """Return a symmetric 6×6 inertia of a child in the coordinates of its parent.

    ``spin`` contains the cosine and sine of a rotation about the coordinate ``axis`` (0, 1 or 2), which is applied
    before ``R``.
    """
    blocks = [symmetric(inertia[:3, :3]), inertia[:3, 3:], symmetric(inertia[3:, 3:])]
    if axis is not None:
        blocks = [_turned(block, axis, *spin) for block in blocks]
    A, B, D = (R @ block @ R.T for block in blocks)
    A, D, P = symmetric(A), symmetric(D), skew(p)
    # At the origin of the parent, B' = B − A[p]× and D' = D + [p]×B + B'ᵀ[p]×ᵀ, where ([p]× B')ᵀ = B'ᵀ [p]×ᵀ.
    shifted = B - A @ P
    return symmetric(ca.blockcat([[A, shifted], [shifted.T, D + P @ B + (P @ shifted).T]]))


def symmetric(matrix: ca.SX) -> ca.SX:
    """Copy the upper triangle to the lower triangle, so that equal entries are the same expression."""
    return ca.triu2symm(ca.triu(matrix))


@template
def quaternion_product(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the Hamilton product of two quaternions in ``x y z w`` order."""
    va, wa, vb, wb = a[:3], a[3], b[:3], b[3]
    return ca.vertcat(wa * vb + wb * va + cross(va, vb), wa * wb - ca.dot(va, vb))


def quaternion_matrix(q: ca.SX) -> ca.SX:
    """Return the rotation matrix of a unit quaternion in ``x y z w`` order."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
