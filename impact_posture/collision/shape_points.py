"""Points whose convex hull holds a shape of coal, and its surface."""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import Any

import coal
import numpy as np

from impact_posture.arrays import Array
from impact_posture.collision.mesh_triangles import Triangles, hull_surface, mesh_points, mesh_triangles

# Corners of the polygon around a circle: it is 0.5 % larger.
_SIDES = 32
# Points around a ball: their hull is 2 % larger.
_BALL = 200


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
