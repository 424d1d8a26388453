"""Corners and triangles of coal shapes, with a correction of triangles that coal reads wrongly.

A node of a mesh file may have several parts, one for each material.  coal 3.0 stacks the corners of all parts, but
numbers the triangles of every part from the first corner of the node.  The triangles of a part begin with the corners
0, 1 and 2 of the part and use all its corners.  From this order, the module detects the parts and checks the result.
If the check fails, the convex hull of the corners, which contains the mesh, replaces the mesh.
"""

from __future__ import annotations

from functools import cache, partial
from itertools import product
from typing import Any, NamedTuple

import coal
import numpy as np
from numpy.typing import NDArray

from impact_posture.collision.swept_hull import SweptHull, hull_corners
from impact_posture.system.arrays import Array

# Number of corners of the polygon around a circle.  The polygon is 0.5 % larger than the circle.
_SIDES = 32
# Number of points whose convex hull replaces a ball.  The hull is 2 % larger than the ball.
_BALL = 200

Triangles = NDArray[np.int_]


class Corrected(NamedTuple):
    """A coal mesh, and whether it is exactly the mesh in the file; otherwise it is the convex hull of that mesh."""

    mesh: Any
    exact: bool


def mesh_points(shape: Any) -> Array:
    """Return the vertices of a coal mesh, shape (k, 3)."""
    return np.asarray(shape.vertices(), dtype=float).reshape(-1, 3)


def mesh_triangles(shape: Any) -> Triangles:
    """Return the triangles of a coal mesh as indices of its vertices, shape (n, 3)."""
    corners = (shape.tri_indices(k) for k in range(shape.num_tris))
    return np.array([(triangle[0], triangle[1], triangle[2]) for triangle in corners], dtype=int).reshape(-1, 3)


def hull_surface(points: Array) -> tuple[Array, Triangles]:
    """Return corners, shape (k, 3), m, and triangles, shape (n, 3), of the convex hull of points."""
    corners = hull_corners(points)
    return corners, SweptHull("", "", 0, corners, 0.0).faces.astype(int)


def triangle_mesh(points: Array, triangles: Triangles) -> Any:
    """Return the coal mesh with the corners ``points``, shape (k, 3), m, and ``triangles``, shape (n, 3)."""
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(points))
    mesh.addVertices(points)
    mesh.addTriangles(triangles)
    mesh.endModel()
    mesh.computeLocalAABB()
    return mesh


def renumbered(count: int, faces: Triangles) -> Triangles | None:
    """Return triangles that use all ``count`` corners; ``None`` if the parts of the file cannot be separated.

    ``faces`` are the triangles with the numbers of coal, shape (n, 3).
    """
    candidates = (shifted(faces) for shifted in (lambda same: same, _shifted, partial(_shifted, across=True)))
    complete = (triangles for triangles in candidates if np.bincount(triangles.ravel(), minlength=count).all())
    return next(complete, None)


def _shifted(faces: Triangles, across: bool = False) -> Triangles:
    """Number the corners of all triangles from the first corner of the file.

    A file consists of nodes, and a node of parts.  The numbers of a new part begin again at the first corner of its
    node.  ``across`` also detects parts that begin a new node.
    """
    starts, shifts, begin = [0], [0], 0
    for k in np.flatnonzero((np.diff(faces, axis=1) == 1).all(axis=1))[1:]:
        first = int(faces[starts[-1], 0])
        end = begin + int(faces[starts[-1] : k].max()) + 1 - first
        if faces[k, 0] == first or (across and faces[k, 0] == end):
            starts.append(int(k))
            shifts.append(end - int(faces[k, 0]))
            begin = end
    return np.asarray(faces + np.repeat(shifts, np.diff([*starts, len(faces)]))[:, None])


def shape_points(shape: Any) -> Array:
    """Return points whose convex hull contains a shape, in the axes of the shape, shape (n, 3), m."""
    match shape:
        case coal.Box():
            return np.asarray(np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide)
        case coal.Sphere():
            return _ball() * float(shape.radius)
        case coal.Ellipsoid():
            return np.asarray(_ball() * np.array(shape.radii))
        case coal.Cylinder():
            return ends(_circle() * float(shape.radius), shape.halfLength)
        case coal.Capsule():
            return ends(_ball() * float(shape.radius), shape.halfLength)
        case _:
            return mesh_points(shape)


def surface_of(shape: Any) -> tuple[Array, Triangles]:
    """Return corners, shape (k, 3), m, and triangles, shape (n, 3), of a mesh, or of the hull around a shape."""
    points = shape_points(shape)
    return (points, mesh_triangles(shape)) if isinstance(shape, coal.BVHModelBase) else hull_surface(points)


def ends(points: Array, half_length: float) -> Array:
    """Return copies of the points, moved along z by ``half_length`` and by ``−half_length``, m, shape (2k, 3)."""
    return np.vstack([points + np.array([0, 0, side * half_length]) for side in (-1, 1)])


@cache
def _circle() -> Array:
    angles = np.arange(_SIDES) * 2 * np.pi / _SIDES
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)], axis=1)
    return np.asarray(around / np.cos(np.pi / _SIDES))


@cache
def _ball() -> Array:
    """Return points on a spiral around the unit ball; the hull of the points contains the ball."""
    from scipy.spatial import ConvexHull

    height = 1 - (2 * np.arange(_BALL) + 1) / _BALL
    angles = np.arange(_BALL) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(angles), ring * np.sin(angles), height], axis=1)
    return np.asarray(points / np.min(-ConvexHull(points).equations[:, 3]))
