"""The swept hulls of a robot: one for each shape, or one for several shapes of a joint that fill a common hull."""

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

# Shapes are merged if no point of their common hull is farther (m) from them.
_FILL = 0.01
# Places on a triangle, as shares of its corners.
_PLACES = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4


class Body(NamedTuple):
    """Shapes in one hull.

    Attributes:
        shapes: Their indices in the geometry, ascending.
        corners: Corners of the hull of each one in the axes of the joint, shape (k, 3) each, m.
    """

    shapes: tuple[int, ...]
    corners: tuple[Array, ...]


def corners_of(shape: pin.GeometryObject) -> Array:
    """Return the corners of a hull that holds a shape, in the axes of its joint, shape (k, 3), m."""
    points = shape_points(shape.geometry)
    return hull_corners(points @ shape.placement.rotation.T + shape.placement.translation)


def merged_bodies(shapes: Sequence[pin.GeometryObject], apart: NDArray[np.bool_]) -> list[Body]:
    """Put the shapes of a robot together where that leaves fewer pairs and hardly more volume.

    Two bodies become one if they move with the same joint, have to keep apart from the same shapes, and no point of
    their common hull is more than 1 cm from them.

    Args:
        shapes: The shapes.
        apart: Whether two shapes have to keep apart, shape (n, n).
    """
    corners = [corners_of(shape) for shape in shapes]
    groups: dict[tuple[int, bytes], list[Body]] = {}
    # A large hull first, because it takes in the small shapes that are in it.
    for k in sorted(range(len(shapes)), key=lambda k: -float(np.prod(np.ptp(corners[k], axis=0)))):
        group = groups.setdefault((int(shapes[k].parentJoint), apart[k].tobytes()), [])
        body = Body((k,), (corners[k],))
        while (joined := _partner(body, group)) is not None:
            group[:] = [other for other in group if other is not joined]
            body = Body((*joined.shapes, *body.shapes), (*joined.corners, *body.corners))
        group.append(body)
    bodies = (body for group in groups.values() for body in group)
    return sorted((Body(tuple(sorted(body.shapes)), body.corners) for body in bodies), key=lambda body: body.shapes)


def _partner(body: Body, group: Sequence[Body]) -> Body | None:
    return next((other for other in group if _fill(other, body)), None)


def _fill(a: Body, b: Body) -> bool:
    """Tell whether no point of the common hull of two bodies is farther from their shapes than allowed."""
    parts = (*a.corners, *b.corners)
    points, part = np.vstack(parts), np.repeat(np.arange(len(parts)), [len(corners) for corners in parts])
    hull = SweptHull("", "", 0, points, 0.0)
    faces = hull.faces
    # A face between corners of one part is in that part, and points of a small face are close to its corners.
    edges = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2).max(axis=1)
    open_faces = np.flatnonzero(np.any(part[faces] != part[faces[:, :1]], axis=1) & (edges > _FILL))
    solids = [SweptHull("", "", 0, _thinned(corners), 0.0) for corners in parts]
    for face in open_faces[np.argsort(-edges[open_faces])]:
        for point in _PLACES @ points[faces[face]]:
            if all(distance_from_hull(point, solid) > _FILL for solid in solids):
                return False
    return len(faces) > 0


def _thinned(corners: Array) -> Array:
    """Return those of many corners that are farthest along 200 directions: coal takes up to 255 edges at a corner."""
    directions = shape_points(coal.Sphere(1.0))
    return corners[np.unique((corners @ directions.T).argmax(axis=0))] if len(corners) > len(directions) else corners
