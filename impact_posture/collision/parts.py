"""Parts of a body with a hollow: its triangles, cut so that the hulls of the parts leave the hollow free."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.collision.mesh_triangles import Triangles, hull_surface, mesh_triangles
from impact_posture.collision.shape_points import shape_points
from impact_posture.collision.swept_hull import SweptHull, hull_corners, separation

TOLERANCE = 0.001
"""Tolerance (m) of the hulls of parts, finer than that of others, because bodies in hollows have little room."""

# A cut is sought across each axis, at so many places that divide the extent evenly.
_PLACES = 9
# The best cut is sought with so many triangles at most, and is made through all.
_MOST_TRIANGLES = 500


class Cut(NamedTuple):
    """A cut of a part.

    Attributes:
        sides: Triangles of each side, shape (n, 3, 3) each, m.
        depth: Sum of the depths (m) to which the other body is in the hulls of the sides.
    """

    sides: tuple[Array, Array]
    depth: float


def triangles_of(shapes: Iterable[pin.GeometryObject]) -> Array:
    """Return the triangles around shapes in the axes of their joint, shape (n, 3, 3), m.

    They are those of a mesh, or of the hull around a primitive shape.
    """
    found = []
    for shape in shapes:
        points, faces = surface_of(shape.geometry)
        found.append((points @ shape.placement.rotation.T + shape.placement.translation)[faces])
    return np.concatenate(found)


def surface_of(solid: Any) -> tuple[Array, Triangles]:
    """Return the corners of a shape in its own axes, shape (k, 3), m, and its triangles as indices, shape (n, 3).

    They are those of a mesh, or of the hull around a primitive shape.
    """
    points = shape_points(solid)
    if isinstance(solid, coal.BVHModelBase):
        return points, mesh_triangles(solid)
    return hull_surface(points)


def best_cut(triangles: Array, other: SweptHull, placements: Sequence[pin.SE3]) -> Cut:
    """Cut triangles by the plane that leaves another body least deep in the hulls of the two sides.

    Triangles across the plane are divided, so that the sides together hold every point of all triangles.  What is
    smaller than the tolerance is not cut; its depth is infinite.

    Args:
        triangles: The triangles, shape (n, 3, 3), m.
        other: The other body.
        placements: Placements of the other body in the axes of the triangles.
    """
    some = triangles[:: -(-len(triangles) // _MOST_TRIANGLES)]
    shares = np.arange(1, _PLACES + 1) / (_PLACES + 1)
    planes = []
    for axis in _axes(triangles):
        low, high = np.min(some @ axis), np.max(some @ axis)
        if high - low > TOLERANCE:
            planes += [(axis, float(low + share * (high - low))) for share in shares]
    if not planes:
        return Cut((triangles, triangles), np.inf)
    depths = [depth([_hull(side) for side in divide(some, *plane)], other, placements) for plane in planes]
    best = int(np.argmin(depths))
    return Cut(divide(triangles, *planes[best]), depths[best])


def depth(parts: Sequence[SweptHull], other: SweptHull, placements: Sequence[pin.SE3]) -> float:
    """Return the sum over placements of the depth (m) to which a body is in hulls, that of the deepest hull each."""
    here = pin.SE3.Identity()
    return sum(-min(0.0, *(separation(part, here, other, at).distance for part in parts)) for at in placements)


def _axes(triangles: Array) -> Array:
    """Return the principal axes of the normals, weighted by area, as rows: those of a box are its edges."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    weights = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(normals.T @ (normals / np.maximum(weights, np.finfo(float).tiny)))[1].T)


def divide(triangles: Array, axis: Array, height: float) -> tuple[Array, Array]:
    """Return the triangles below and above the plane ``axis·x = height``; those across it are divided into three."""
    heights = triangles @ axis
    above = heights > height
    count = above.sum(axis=1)
    sides = [triangles[count == 0], triangles[count == 3]]
    # Triangles with one corner above, then those with one corner below.  That corner comes first.
    for own, alone in ((1, above & (count == 1)[:, None]), (0, ~above & (count == 2)[:, None])):
        across, first = np.nonzero(alone)
        a, b, c = (triangles[across, (first + k) % 3] for k in range(3))
        of_a, of_b, of_c = (heights[across, (first + k) % 3, None] for k in range(3))
        on_b, on_c = a + (height - of_a) / (of_b - of_a) * (b - a), a + (height - of_a) / (of_c - of_a) * (c - a)
        tip, rest = np.stack([a, on_b, on_c], axis=1), np.stack([on_b, b, c, on_b, c, on_c], axis=1)
        sides[own] = np.concatenate([sides[own], tip])
        sides[1 - own] = np.concatenate([sides[1 - own], rest.reshape(-1, 3, 3)])
    return sides[0], sides[1]


def _hull(triangles: Array) -> SweptHull:
    """Return about the hull that would be fitted to triangles."""
    return SweptHull("", "", 0, hull_corners(triangles.reshape(-1, 3)), TOLERANCE)
