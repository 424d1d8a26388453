"""Ellipsoids as points and lines: projections onto planes, half-widths and surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.robot.support_polygon import convex_ring
from impact_posture.system.arrays import Array

# A direction within 1° of a plane counts as in the plane.  The relative error of its half-width is below 2e-4.
IN_PLANE = float(np.cos(np.radians(1.0)))
# A semi-axis shorter than this share of the longest semi-axis is a rounding error, or too short to be visible.
_NEGLIGIBLE = 1e-6
# Directions in which :func:`outline` searches for extreme points, shape (16, 2).
_AROUND = np.array([[np.cos(angle), np.sin(angle)] for angle in np.arange(16) * np.pi / 8])


@dataclass(frozen=True, eq=False)
class Plane:
    """Plane on which figures project points.

    Attributes:
        axes: Orthonormal world directions, drawn to the right (first row) and up (second row), shape (2, 3).
        right: Name of the first axis.
        up: Name of the second axis.
    """

    axes: Array
    right: str
    up: str

    @property
    def name(self) -> str:
        """Name of the plane, such as ``xy``."""
        return f"{self.right}{self.up}" if len(self.right + self.up) == 2 else "plane of n and z"

    def contains(self, direction: Array) -> bool:
        """Return whether the angle between a unit direction and the plane is at most 1°."""
        return bool(np.linalg.norm(self.axes @ direction) >= IN_PLANE)


_X, _Y, _Z = np.eye(3)
XY = Plane(np.array([_X, _Y]), "x", "y")
XZ = Plane(np.array([_X, _Z]), "x", "z")
YZ = Plane(np.array([_Y, _Z]), "y", "z")
COORDINATE_PLANES = (XY, XZ, YZ)


def upright_plane(n: Array) -> Plane:
    """Return the plane through the vertical axis and the unit vector ``n``, which is not vertical."""
    across = np.array([n[0], n[1], 0.0]) / np.hypot(n[0], n[1])
    name = f"along ({across[0]:.2f}, {across[1]:.2f}, 0)".replace("-", "−")
    return Plane(np.array([across, _Z]), name, "z")


def root(matrix: Array) -> Array:
    """Return the symmetric square root of a positive semidefinite matrix, with negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def half_width(matrix: Array, direction: Array) -> float:
    """Return the half-width ``√(dᵀΛd)`` of ``{x: xᵀΛ⁻¹x ≤ 1}`` along a unit vector ``d``.

    The half-width is half the distance between the two tangent planes that are perpendicular to ``d``.
    """
    return float(np.sqrt(max(float(direction @ matrix @ direction), 0.0)))


def longest(matrix: Array) -> float:
    """Return the longest semi-axis of ``{x: xᵀΛ⁻¹x ≤ 1}``."""
    return float(np.sqrt(max(float(np.linalg.eigvalsh(matrix)[-1]), 0.0)))


def shadow(matrix: Array, axes: Array, points: int = 181) -> Array:
    """Return the outline of the projection of ``{x: xᵀΛ⁻¹x ≤ 1}`` onto the plane of ``axes``, shape (2, points).

    The projection is the ellipse of ``P Λ Pᵀ``, where the rows of ``P = axes`` are orthonormal.  A degenerate ellipse
    is a segment or a point.
    """
    return _ring(_semi_axes(axes @ matrix @ axes.T), points)


def surface(matrix: Array, rings: int = 25) -> Array:
    """Return points of the surface of the ellipsoid on a grid, shape (3, rings, 2·rings)."""
    across, around = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings), indexing="ij")
    sphere = np.array([np.sin(across) * np.cos(around), np.sin(across) * np.sin(around), np.cos(across)])
    return np.asarray(np.einsum("ij,jkl->ikl", root(matrix), sphere))


def principal_sections(matrix: Array) -> list[Array]:
    """Return the sections of an ellipsoid through pairs of principal axes, shape (3, 121) each.

    Sections that are points are left out.
    """
    axes = _semi_axes(matrix)
    flat = _NEGLIGIBLE * np.linalg.norm(axes[:, 2])
    pairs = [pair for pair in ([0, 1], [0, 2], [1, 2]) if np.linalg.norm(axes[:, pair[1]]) > flat]
    # If the ellipsoid is a segment, two of its sections are the same segment.
    pairs = pairs[1:] if len(pairs) == 2 and np.linalg.norm(axes[:, 1]) <= flat else pairs
    return [_ring(axes[:, pair], 121) for pair in pairs]


def _semi_axes(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _ring(axes: Array, points: int) -> Array:
    """Return the ellipse with two semi-axes (columns, the longer last); a segment if the shorter is negligible."""
    angle = np.linspace(0.0, 2 * np.pi, points)
    # A segment is drawn in one direction only, because a second pass would fill the gaps of dashed lines.
    if np.linalg.norm(axes[:, 0]) <= _NEGLIGIBLE * np.linalg.norm(axes[:, 1]):
        angle = np.linspace(0.0, np.pi, points)
        return np.asarray(axes[:, 1:] * np.cos(angle))
    return np.asarray(axes[:, ::-1] @ np.array([np.cos(angle), np.sin(angle)]))


def polar(matrix: Array, infinite: float) -> tuple[Array, Array]:
    """Return the matrix ``A⁻¹`` of the ellipsoid ``{f: fᵀAf ≤ 1}``, and its unbounded directions.

    ``A`` is ``matrix``, positive semidefinite, shape (3, 3).  The ellipsoid is unbounded in the null space of ``A``.
    In ``A⁻¹``, these unbounded directions, columns of shape (3, k), have the half-length ``infinite``.
    """
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    bounded = values > 1e-10 * max(float(values[-1]), 1e-300)
    inverse = np.where(bounded, 1 / np.where(bounded, values, 1.0), infinite**2)
    return np.asarray((vectors * inverse) @ vectors.T), np.asarray(vectors[:, ~bounded])


def cone_rim(axis: Array, degrees: float, length: float, points: int = 73) -> Array:
    """Return the rim of a cone around a unit ``axis``: a closed circle, shape (3, points).

    ``degrees`` is the angle from the axis, and ``length`` is the distance from the apex, which is the origin.
    """
    across = np.linalg.svd(axis[None])[2][1:]
    angle, tilt = np.linspace(0.0, 2 * np.pi, points), np.radians(degrees)
    around = across.T @ np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(length * (np.cos(tilt) * axis[:, None] + np.sin(tilt) * around))


def cone_shadow(axis: Array, degrees: float, length: float, axes: Array) -> Array:
    """Return the closed outline of the projected cone from the origin to :func:`cone_rim`, shape (2, k)."""
    return outline(np.column_stack([np.zeros(2), axes @ cone_rim(axis, degrees, length)[:, :-1]]))


def outline(points: Array) -> Array:
    """Return the closed convex hull of points of shape (2, k)."""
    extreme = points[:, (_AROUND @ points).argmax(axis=1)]
    steps = np.roll(extreme, -1, axis=1) - extreme
    sides = np.flatnonzero(steps.any(axis=0))
    # Remove the points inside the polygon of the extreme points, because they cannot be corners of the hull.
    dx, dy = points[:, None] - extreme[:, sides, None]
    left = steps[0, sides, None] * dy - steps[1, sides, None] * dx
    points = points[:, (left <= 0).any(axis=0) | (sides.size == 0)]
    edge = convex_ring(points.T)
    return np.asarray(points[:, [*edge, edge[0]]])


def square(center: Array, n: Array, side: float) -> Array:
    """Return the closed outline of a square perpendicular to the unit vector ``n``, shape (3, 5)."""
    # One edge follows the projection of the world axis that is most perpendicular to n.
    first = np.eye(3)[int(np.argmin(np.abs(n)))]
    first = first - (first @ n) * n
    first = first / np.linalg.norm(first)
    second = np.cross(n, first)
    corners = np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]]) * side / 2
    return np.asarray(center[:, None] + np.outer(first, corners[0]) + np.outer(second, corners[1]))
