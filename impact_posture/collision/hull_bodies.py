"""Merge shapes of a robot that fill most of a common convex hull."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.collision.shape_corners import shape_points
from impact_posture.collision.swept_hull import SweptHull, distance_from_hull, hull_corners
from impact_posture.system.arrays import Array

# Largest distance (m) from a point of a common hull to the nearest of the merged shapes.
_FILL = 0.01
# Test points on a triangle, as weights of its corners.
_PLACES = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4


class Body(NamedTuple):
    """Shapes with a common hull.

    ``shapes`` are ascending indices of shapes.  ``corners`` are the hull corners of each shape in the axes of the
    joint, shape (k, 3), m.
    """

    shapes: tuple[int, ...]
    corners: tuple[Array, ...]


def merged_bodies(shapes: Sequence[pin.GeometryObject], apart: NDArray[np.bool_]) -> list[Body]:
    """Merge shapes of a robot into bodies, so that fewer pairs of bodies must be checked for collisions.

    Two bodies are merged if they have the same joint and must stay apart from the same shapes.  In addition, every
    point of their common hull must be within 1 cm of at least one of the bodies.  ``apart``, shape (n, n), tells
    whether two shapes must not touch.
    """
    corners = [
        hull_corners(shape_points(shape.geometry) @ shape.placement.rotation.T + shape.placement.translation)
        for shape in shapes
    ]
    groups: dict[tuple[int, bytes], list[Body]] = {}
    # Start with large hulls, because they absorb the small shapes inside them.
    for k in sorted(range(len(shapes)), key=lambda k: -float(np.prod(np.ptp(corners[k], axis=0)))):
        group = groups.setdefault((int(shapes[k].parentJoint), apart[k].tobytes()), [])
        body = Body((k,), (corners[k],))
        while (partner := next((other for other in group if _fill(other, body)), None)) is not None:
            group[:] = [other for other in group if other is not partner]
            body = Body((*partner.shapes, *body.shapes), (*partner.corners, *body.corners))
        group.append(body)
    bodies = (body for group in groups.values() for body in group)
    return sorted((Body(tuple(sorted(body.shapes)), body.corners) for body in bodies), key=lambda body: body.shapes)


def _fill(a: Body, b: Body) -> bool:
    """Return whether every point of the common hull of two bodies is within ``_FILL`` of one of the bodies."""
    parts = (*a.corners, *b.corners)
    points, part = np.vstack(parts), np.repeat(np.arange(len(parts)), [len(corners) for corners in parts])
    hull = SweptHull("", "", 0, points, 0.0)
    faces = hull.faces
    # Check only large faces of the hull whose corners belong to different shapes.  All other faces are near a shape.
    edges = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2).max(axis=1)
    open_faces = np.flatnonzero(np.any(part[faces] != part[faces[:, :1]], axis=1) & (edges > _FILL))
    solids = [SweptHull("", "", 0, _thinned(corners), 0.0) for corners in parts]
    for face in open_faces[np.argsort(-edges[open_faces])]:
        for point in _PLACES @ points[faces[face]]:
            if all(distance_from_hull(point, solid) > _FILL for solid in solids):
                return False
    return len(faces) > 0


def _thinned(corners: Array) -> Array:
    """Reduce more than 200 corners to the corners that are farthest along one of 200 directions.

    At most 200 corners remain, so no corner has more than 199 edges.  Coal allows at most 255 edges.
    """
    directions = shape_points(coal.Sphere(1.0))
    return corners[np.unique((corners @ directions.T).argmax(axis=0))] if len(corners) > len(directions) else corners
