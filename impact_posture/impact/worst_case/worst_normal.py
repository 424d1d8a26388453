"""The exact worst normal of a cone, ``max nᵀAn`` over ``∠(n, n₀) ≤ α``, with the multiplier that proves optimality.

The unit normals of a cone form a cap of the sphere.  The maximum of a quadratic form on the cap is at an eigenvector
inside the cap, or on the edge of the cap.  On the edge, the form is a trigonometric polynomial of degree two.  For
every normal of the cone and any ``μ ≥ 0``, ``bound = λ_max(A + μ(n₀n₀ᵀ − cos²α I)) ≥ nᵀAn``.  Equality holds for the
optimal ``μ`` and normal (S-lemma).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from impact_posture.system.arrays import Array

# Two values of the form are treated as equal if they differ by less than this fraction of |A| sin α.
TIED = 1e-6
# Two worst normals are treated as the same if their distance is below this fraction of sin α.
_APART = 1e-2
# Two values differ only by rounding if their difference is below this fraction of |A|.
_EQUAL = 1e-14
_SMALL = float(np.finfo(float).tiny)
_POLISH = 20
_GRID = np.linspace(0, 2 * np.pi, 72, endpoint=False)


@dataclass(frozen=True, eq=False)
class WorstNormal:
    """The maximum of ``nᵀAn`` over a cone of normals.

    Attributes:
        value: The maximum of ``nᵀAn``.
        normal: Normal that attains the maximum, shape (3,); the first row of ``normals``.
        normals: All normals that attain the maximum, as rows, shape (k, 3); samples if they form an arc or a circle.
        angle_deg: Angle between ``normal`` and the axis of the cone, degrees.
        multiplier: Multiplier ``μ ≥ 0`` of the dual problem; zero if the maximum is inside the cone.
        bound: ``λ_max(A + μ(n₀n₀ᵀ − cos²α I))``, an upper bound of ``nᵀAn`` over the cone.
    """

    value: float
    normal: Array
    normals: Array
    angle_deg: float
    multiplier: float
    bound: float

    @property
    def tied(self) -> bool:
        """Whether several normals attain the maximum; the maximum then has subgradients but no gradient."""
        return len(self.normals) > 1

    def turned(self, R: Array) -> WorstNormal:
        """Return the same maximum with its normals multiplied by the rotation ``R``, shape (3, 3)."""
        return replace(self, normal=R @ self.normal, normals=self.normals @ R.T)

    def to_dict(self) -> dict[str, object]:
        """Return the ``cone`` block of an evaluation."""
        return {
            "angle_deg": self.angle_deg,
            "tied": self.tied,
            "normals": self.normals.tolist(),
            "multiplier": self.multiplier,
        }


def cone_axes(n: Array) -> Array:
    """Return orthonormal axes as columns, shape (3, 3), with ``n`` as first column; accurate for every unit ``n``."""
    x, y, z = (float(v) for v in n)
    side = 1.0 if z >= 0 else -1.0
    # Duff et al., "Building an orthonormal basis, revisited", JCGT 6 (2017).
    a = -1 / (side + z)
    b = x * y * a
    return np.array([[x, 1 + side * x * x * a, b], [y, side * b, side + y * y * a], [z, -side * x, -y]])


def worst_normal(A: Array, axis: Array, cone_deg: float) -> WorstNormal:
    """Maximize ``nᵀAn`` over the unit vectors within ``cone_deg`` degrees (0 < α < 90) of ``axis``.

    ``A`` is symmetric and may be indefinite, shape (3, 3).  ``axis`` is a unit vector, shape (3,).
    """
    alpha = np.deg2rad(cone_deg)
    c, s = float(np.cos(alpha)), float(np.sin(alpha))
    axes = cone_axes(axis)
    P = axes.T @ A @ axes
    size = max(float(np.abs(P).max()), _SMALL)
    candidates = np.vstack([_inside(P, c, s * size), _on_edge(P, c, s, size)])
    values = np.einsum("ki,ij,kj->k", candidates, P, candidates)
    best = float(values.max())
    # Rounding errors must not determine which normal comes first.  Candidates with equal values are sorted by
    # coordinates.
    near = [k for k in range(len(candidates)) if values[k] >= best - TIED * s * size]
    near.sort(key=lambda k: (round((best - values[k]) / (_EQUAL * size)), *(-candidates[k])))
    apart: list[Array] = []
    for k in near:
        if all(np.linalg.norm(candidates[k] - other) > _APART * s for other in apart):
            apart.append(candidates[k])
    multiplier = _multiplier(P, apart[0], c, s)
    shifted = P + multiplier * np.diag([s * s, -c * c, -c * c])
    normals = np.array(apart) @ axes.T
    return WorstNormal(
        value=float(normals[0] @ A @ normals[0]),
        normal=normals[0],
        normals=normals,
        angle_deg=float(np.rad2deg(np.arctan2(np.linalg.norm(apart[0][1:]), apart[0][0]))),
        multiplier=multiplier,
        bound=float(np.linalg.eigvalsh(shifted)[-1]),
    )


def tied_normals(A: Array, axis: Array, cone_deg: float, worst: WorstNormal, tolerance: float) -> Array:
    """Return the normals whose value is at most ``tolerance · |A|`` below the largest value, shape (k, 3).

    The worst normal comes first.  If these normals form an arc, a circle or a cap, enough samples are returned to
    represent the convex hull.
    """
    alpha = np.deg2rad(cone_deg)
    size = float(np.abs(A).max())
    axes = cone_axes(axis)
    circle = np.stack([np.cos(_GRID), np.sin(_GRID)])
    values, vectors = np.linalg.eigh(A)
    top = vectors[:, values >= values[-1] - tolerance * size]
    # If the largest eigenvalue is double, the plane of its eigenvectors cuts the cap in an arc of worst normals.  If
    # the largest eigenvalue is triple, all normals of the cap are worst normals.
    tilts = alpha * (np.linspace(0, 1, 9) if top.shape[1] == 3 else np.ones(1))
    rings = [np.vstack([np.full_like(_GRID, np.cos(tilt)), np.sin(tilt) * circle]) for tilt in tilts]
    planes = [top[:, [i, j]] @ circle for i in range(top.shape[1]) for j in range(i)]
    more = np.hstack([*[axes @ ring for ring in rings], *planes]).T
    more = more[more @ axis >= np.cos(alpha) * (1 - 1e-12)]
    heights = np.einsum("ki,ij,kj->k", more, A, more)
    return np.vstack([worst.normals, more[heights >= worst.value - tolerance * size]])


def _multiplier(P: Array, n: Array, c: float, s: float) -> float:
    """Return the ``μ`` for which ``(P + μ diag(s², −c², −c²)) n = t n``, in a form without cancellation."""
    if n[0] > c * (1 + 1e-12):
        return 0.0
    w = n[1:] / np.linalg.norm(n[1:])
    return max(0.0, float((2 * c * c - 1) / (c * s) * (P[0, 1:] @ w) + w @ P[1:, 1:] @ w - P[0, 0]))


def _inside(P: Array, c: float, size: float) -> Array:
    """Return the unit eigenvectors of the largest eigenvalue within the cap, in the axes of the cap.

    If there are several, the eigenvector nearest to the axis is included.
    """
    values, vectors = np.linalg.eigh(P)
    top = vectors[:, values >= values[-1] - TIED * size]
    candidates = [*top.T]
    nearest = top @ top[0]
    if np.linalg.norm(nearest) > 0:
        candidates.append(nearest / np.linalg.norm(nearest))
    turned = np.array([v if v[0] >= 0 else -v for v in candidates])
    return turned[turned[:, 0] >= c]


def _on_edge(P: Array, c: float, s: float, size: float) -> Array:
    """Return the normals ``(c, s cos φ, s sin φ)`` on the edge of the cap with a local maximum of the form, as rows.

    If the form is constant on the edge, three normals on the edge are returned.
    """
    # The value divided by 2s is Re(A z + B z²) plus a constant, with z = exp(iφ).
    A, B = c * complex(P[0, 1], -P[0, 2]), s * complex(P[1, 1] - P[2, 2], -2 * P[1, 2]) / 4

    def height(x: Array, order: int = 0) -> Array:
        """Return Re(A z + B z²) at the angles ``x``, or its derivative of the given order."""
        z = np.exp(1j * x)
        return np.asarray((1j**order * (A * z + 2**order * B * z * z)).real)

    # The slope is zero at the roots z of a polynomial.  The angles of all roots are starts for Newton's method.
    roots = np.roots([2 * B, A, 0, -A.conjugate(), -2 * B.conjugate()])
    phi = np.concatenate([np.angle(roots), _GRID[[int(height(_GRID).argmax())]]])
    swing = max(abs(A) + 2 * abs(B), _SMALL)
    for _ in range(_POLISH):
        slope, bend = height(phi, 1), height(phi, 2)
        step = np.where(bend < 0, slope / np.minimum(bend, -1e-8 * swing), 0.0)
        phi = phi - np.clip(step, -0.2, 0.2)
        if np.abs(step).max() < 1e-15:
            break
    kept = (height(phi, 2) < 0) & (np.abs(height(phi, 1)) <= 1e-10 * swing)
    # The test above misses a maximum whose second derivative is zero, so the highest candidate is always kept.
    heights = height(phi)
    highest = int(heights.argmax())
    kept[highest] |= not (heights[kept] >= heights[highest] - _EQUAL * swing / 2).any()
    phi = phi[kept]
    if 4 * swing <= TIED * size:
        phi = np.concatenate([phi, 2 * np.pi / 3 * np.arange(3)])
    return np.stack([np.full_like(phi, c), s * np.cos(phi), s * np.sin(phi)], axis=1)
