"""Sphere-swept convex hulls: signed distance, fit around points, and hulls of obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from heapq import heapify, heapreplace
from itertools import product
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from impact_posture.config.cached_values import StoredArray
from impact_posture.config.obstacle import Obstacle
from impact_posture.system.arrays import Array

MOST_VERTICES = 40
"""Largest number of vertices of a hull, because every vertex adds a constraint to the optimization."""

# Points are treated as flat if their extent in one direction is below this value (m).  The hull of flat points is
# made twice as thick as this value.
_THIN = 1e-4
_REQUEST = coal.DistanceRequest(True)
_REQUEST.gjk_tolerance = 1e-12
_POINT = coal.Sphere(0.0)
# The fit adds corners to a hull until no point is outside the hull by more than this value (m).
_TOLERANCE = 0.004
# Largest number of candidates for corners; the sweep radius is computed from all points.
_MOST_CANDIDATES = 4000
_CHUNK = 20_000
# For fewer points than this, computing the convex hull takes more time than it saves.
_FEW = 50
# Largest error (m) of distances that coal computes.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class SweptHull:
    """All points within ``radius`` of a convex hull that moves with a joint.

    Attributes:
        name: Unique name for messages, made of the name of the link and the number of the shape.
        joint: Index of the joint in the model; 0 is the world.
        vertices: Corners of the hull in the axes of the joint, shape (k, 3) with k ≤ 40, m.
        radius: Sweep radius, m.
        known_faces: The value of ``faces``, if it is known.
    """

    name: str
    link: str
    joint: int
    vertices: StoredArray
    radius: float
    known_faces: StoredArray | None = None

    @cached_property
    def center(self) -> Array:
        """Center of the box around the vertices, in the axes of the joint, shape (3,), m."""
        return np.asarray((self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2)

    @cached_property
    def reach(self) -> float:
        """Radius of a sphere about ``center`` that contains the swept hull, m."""
        return float(np.linalg.norm(self.vertices - self.center, axis=1).max()) + self.radius

    @cached_property
    def faces(self) -> Array:
        """Triangles of the hull as indices into ``vertices``, shape (n, 3); empty for a point or a segment."""
        if self.known_faces is not None:
            return self.known_faces
        if len(self.vertices) < 4:
            return np.array([[0, 1, 2], [0, 2, 1]] if len(self.vertices) == 3 else np.zeros((0, 3)), dtype=int)
        return np.asarray(_convex_hull(self.vertices).simplices)

    @cached_property
    def solid(self) -> tuple[Any, pin.SE3]:
        """The swept hull as a coal shape, and its placement in the axes of the joint."""
        if len(self.vertices) == 1:
            return coal.Sphere(self.radius), pin.SE3(np.eye(3), self.vertices[0])
        if len(self.vertices) == 2:
            span = self.vertices[1] - self.vertices[0]
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), span).matrix()
            return coal.Capsule(self.radius, float(np.linalg.norm(span))), pin.SE3(turn, self.center)
        # coal searches a mesh from vertex to neighboring vertex, so each vertex must belong to a face.
        used, faces = np.unique(self.faces, return_inverse=True)
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(list(self.vertices[used]))
        triangles.extend([coal.Triangle(*face) for face in faces.reshape(-1, 3).tolist()])
        shape = coal.Convex(points, triangles)
        shape.setSweptSphereRadius(self.radius)
        return shape, pin.SE3.Identity()


class Separation(NamedTuple):
    """Signed distance of two swept hulls including their radii, m; negative if the hulls penetrate each other.

    The unit normal points from ``b`` to ``a``.  Normal and closest points (m) are in world axes, shape (3,).
    """

    distance: float
    normal: Array
    point_a: Array
    point_b: Array


def separation(a: SweptHull, placement_a: pin.SE3, b: SweptHull, placement_b: pin.SE3) -> Separation:
    """Return the signed distance of two swept hulls for world placements of their joints."""
    (shape_a, local_a), (shape_b, local_b) = a.solid, b.solid
    distance, result = _measure(shape_a, placement_a * local_a, shape_b, placement_b * local_b)
    points = np.array(result.getNearestPoint1()), np.array(result.getNearestPoint2())
    return Separation(distance, -np.array(result.normal), *points)


def distance_from_hull(point: Array, hull: SweptHull) -> float:
    """Return the distance of a point, in the axes of the joint, from a swept hull, m."""
    return _measure(_POINT, pin.SE3(np.eye(3), point), *hull.solid)[0]


def _measure(a: Any, at_a: pin.SE3, b: Any, at_b: pin.SE3) -> tuple[float, Any]:
    result = coal.DistanceResult()
    distance = coal.distance(a, transform(at_a), b, transform(at_b), _REQUEST, result)
    if not np.isfinite(result.normal).all():
        # If two corners coincide, coal computes no normal.  A shift by a nanometer separates the corners.
        at_a.translation = at_a.translation + np.array([0.6, 0.64, 0.48]) * 1e-9
        result = coal.DistanceResult()
        distance = coal.distance(a, transform(at_a), b, transform(at_b), _REQUEST, result)
    return float(distance), result


def transform(placement: pin.SE3) -> Any:
    """Return a placement as a coal transform."""
    return coal.Transform3s(placement.rotation, placement.translation)


def hull_corners(points: Array) -> Array:
    """Return the corners of the convex hull of points, shape (k, 3).

    A slab of 0.2 mm thickness replaces flat points.  The two end points replace points on a line, and one point
    replaces points closer than 0.1 mm.
    """
    middle = points.mean(axis=0)
    axes = np.linalg.eigh((points - middle).T @ (points - middle))[1]
    along = (points - middle) @ axes[:, ::-1]
    extent = np.ptp(along, axis=0)
    if extent[0] < _THIN:
        return np.asarray(middle[None])
    if extent[1] < _THIN:
        ends = along[[np.argmin(along[:, 0]), np.argmax(along[:, 0])], :1]
        return np.asarray(middle + ends * axes[:, 2])
    if extent[2] < _THIN:
        points = np.vstack([points - _THIN * axes[:, 0], points + _THIN * axes[:, 0]])
    return np.asarray(points[_convex_hull(points).vertices])


def _convex_hull(points: Array) -> Any:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points)
    except QhullError:
        # The points are flat up to rounding errors, so the option QJ of Qhull moves the points at random by tiny
        # amounts.
        return ConvexHull(points, qhull_options="QJ")


class Fit(NamedTuple):
    """Corners of a hull, shape (k, 3), m, and the sweep radius (m) with which the hull contains all points."""

    vertices: Array
    radius: float


def fit_hull(points: Array) -> Fit:
    """Fit a sphere-swept convex hull that contains points, shape (n, 3), m.

    Candidates are the corners of the convex hull of the points.  Each step adds the candidate farthest from the
    fitted hull, until all candidates are within :data:`_TOLERANCE` of the fitted hull, or the hull has 40 corners.
    The sweep radius is the largest distance of a point from the fitted hull.
    """
    corners = hull_corners(points)
    candidates = corners[:: -(-len(corners) // _MOST_CANDIDATES)]
    axes = np.linalg.eigh(np.cov(candidates.T))[1] if len(candidates) > 1 else np.eye(3)
    chosen = list(dict.fromkeys(int(np.argmax(candidates @ axis)) for axis in np.hstack([axes, -axes]).T))
    # When the hull grows, the distances of the points from the hull can only decrease.  Earlier distances are
    # therefore upper bounds, and only the largest are computed again.
    bounds = np.linalg.norm(candidates[:, None] - candidates[chosen], axis=2).min(axis=1)
    queue = [(-bound, k) for k, bound in enumerate(bounds.tolist())]
    heapify(queue)
    while True:
        vertices = candidates[chosen]
        hull = SweptHull("", "", 0, vertices, 0.0)
        seen: set[int] = set()
        while queue[0][1] not in seen:
            k = queue[0][1]
            seen.add(k)
            heapreplace(queue, (-distance_from_hull(candidates[k], hull), k))
        if len(chosen) >= min(MOST_VERTICES, len(candidates)) or -queue[0][0] <= _TOLERANCE:
            break
        chosen.append(queue[0][1])
    outside = _extreme(_outside(points, hull))
    return Fit(vertices, max((distance_from_hull(p, hull) for p in outside), default=0.0) + _ROUNDING)


def _extreme(points: Array) -> Array:
    """Return the corners of the hull of points.  The largest distance from a convex set is at a corner."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(points[ConvexHull(points).vertices]) if len(points) > _FEW else points
    except QhullError:
        return points


def _outside(points: Array, hull: SweptHull) -> Array:
    """Return the points outside a hull.  Points are checked in chunks, to limit the memory for a million points."""
    if not len(hull.faces):
        return points
    corners = hull.vertices[hull.faces] - hull.center
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    parts = np.array_split(points - hull.center, -(-len(points) // _CHUNK))
    inside = [np.all(part @ (normals * np.sign(offsets)[:, None]).T <= np.abs(offsets), axis=1) for part in parts]
    return np.asarray(points[~np.concatenate(inside)])


def obstacle_hull(obstacle: Obstacle) -> SweptHull:
    """Return an obstacle as a swept hull in the world."""
    name, center = obstacle.name, np.array(obstacle.position)
    if obstacle.box is None:
        return SweptHull(name, name, 0, center[None], float(obstacle.sphere or 0.0))
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * obstacle.box
    x, y, z, w = np.array(obstacle.quaternion) / np.linalg.norm(obstacle.quaternion)
    return SweptHull(name, name, 0, center + corners @ pin.Quaternion(w, x, y, z).matrix().T, 0.0)
