"""Corners and triangles of the shapes of coal, with the triangles of meshes as coal should have read them.

Where a node of a file holds several parts (one for each material), coal 3.0 appends the corners of all, but numbers
the triangles of each part from the first corner of the node.  A part begins with its corners 0, 1 and 2 and uses all
of its corners, so the places where parts begin can be found, and the find can be checked.  Where they cannot be
found, the convex hull of the corners takes the place of the mesh, because it holds all of it.
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

# Corners of the polygon around a circle: it is 0.5 % larger.
_SIDES = 32
# Points around a ball: their hull is 2 % larger.
_BALL = 200

Triangles = NDArray[np.int_]


class Corrected(NamedTuple):
    """A mesh of coal, and whether it is the surface of the file (else its convex hull)."""

    mesh: Any
    exact: bool


def mesh_points(shape: Any) -> Array:
    """Return the vertices of a mesh of coal, shape (k, 3)."""
    return np.asarray(shape.vertices(), dtype=float).reshape(-1, 3)


def mesh_triangles(shape: Any) -> Triangles:
    """Return the triangles of a mesh of coal as indices of its vertices, shape (n, 3)."""
    corners = (shape.tri_indices(k) for k in range(shape.num_tris))
    return np.array([(triangle[0], triangle[1], triangle[2]) for triangle in corners], dtype=int).reshape(-1, 3)


def hull_surface(points: Array) -> tuple[Array, Triangles]:
    """Return corners, shape (k, 3), m, and triangles, shape (n, 3), of the convex hull of points."""
    corners = hull_corners(points)
    return corners, SweptHull("", "", 0, corners, 0.0).faces.astype(int)


def correct(shape: Any) -> Corrected:
    """Return a mesh of coal with the triangles that its file describes."""
    points, faces = mesh_points(shape), mesh_triangles(shape)
    found = renumbered(len(points), faces)
    if found is faces:
        return Corrected(shape, True)
    surface = hull_surface(points) if found is None else (points, found)
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(surface[1]), len(surface[0]))
    mesh.addVertices(surface[0])
    mesh.addTriangles(surface[1])
    mesh.endModel()
    mesh.computeLocalAABB()
    return Corrected(mesh, found is not None)


def renumbered(count: int, faces: Triangles) -> Triangles | None:
    """Return triangles that use every corner; ``None`` where the parts of the file cannot be told apart.

    Args:
        count: Number of corners.
        faces: Triangles as coal numbers them, shape (n, 3).
    """
    candidates = (shifted(faces) for shifted in (lambda same: same, _shifted, partial(_shifted, across=True)))
    return next((found for found in candidates if np.bincount(found.ravel(), minlength=count).all()), None)


def _shifted(faces: Triangles, across: bool = False) -> Triangles:
    """Return the triangles with each part numbered after the last.

    A part begins where the first corners of its node come again; ``across`` nodes, also where those of the next do.
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
    """Return points whose convex hull holds a shape in its own axes, shape (n, 3), m.

    They are the corners of a box or mesh.  A round shape gets a polyhedron around it.
    """
    match shape:
        case coal.Box():
            return np.asarray(np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide)
        case coal.Sphere():
            return _ball() * float(shape.radius)
        case coal.Cylinder():
            return _ends(_circle() * float(shape.radius), shape.halfLength)
        case coal.Capsule():
            return _ends(_ball() * float(shape.radius), shape.halfLength)
        case _:
            return mesh_points(shape)


def surface_of(shape: Any) -> tuple[Array, Triangles]:
    """Return the corners of a shape in its own axes, shape (k, 3), m, and its triangles as indices, shape (n, 3).

    They are those of a mesh, or of the hull around a primitive shape.
    """
    points = shape_points(shape)
    return (points, mesh_triangles(shape)) if isinstance(shape, coal.BVHModelBase) else hull_surface(points)


def _ends(points: Array, half_length: float) -> Array:
    return np.vstack([points + np.array([0, 0, side * half_length]) for side in (-1, 1)])


@cache
def _circle() -> Array:
    angles = np.arange(_SIDES) * 2 * np.pi / _SIDES
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)], axis=1)
    return np.asarray(around / np.cos(np.pi / _SIDES))


@cache
def _ball() -> Array:
    """Return points on a spiral around the unit ball whose hull holds the ball."""
    from scipy.spatial import ConvexHull

    height = 1 - (2 * np.arange(_BALL) + 1) / _BALL
    angles = np.arange(_BALL) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(angles), ring * np.sin(angles), height], axis=1)
    return np.asarray(points / np.min(-ConvexHull(points).equations[:, 3]))
