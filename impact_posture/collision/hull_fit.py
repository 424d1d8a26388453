"""Fit of a sphere-swept convex hull around points: few corners, and the remainder as sweep radius."""

from __future__ import annotations

from heapq import heapify, heapreplace
from typing import NamedTuple

import numpy as np

from impact_posture.arrays import Array
from impact_posture.collision.swept_hull import MOST_VERTICES, SweptHull, distance_from_hull, hull_corners

# A hull gets corners until no point is farther (m) outside it.
_TOLERANCE = 0.004
# Corners are chosen among so many points at most; the sweep radius is that of all points.
_MOST_CANDIDATES = 4000
_CHUNK = 20_000
# Points that are not worth a hull of their own.
_FEW = 50
# Error (m) of a distance by coal.
_ROUNDING = 1e-9


class Fit(NamedTuple):
    """Corners of a hull, shape (k, 3), m, and the sweep radius (m) with which it holds the points."""

    vertices: Array
    radius: float


def fit_hull(points: Array, tolerance: float = _TOLERANCE) -> Fit:
    """Fit a sphere-swept convex hull that holds the convex hull of points, shape (n, 3), m.

    The corner farthest from the hull of those chosen is added, until all are within the tolerance (m) of it or 40 are
    chosen.  The sweep radius is the largest distance of a point from the hull, so every point is held.
    """
    corners = hull_corners(points)
    candidates = corners[:: -(-len(corners) // _MOST_CANDIDATES)]
    axes = np.linalg.eigh(np.cov(candidates.T))[1] if len(candidates) > 1 else np.eye(3)
    chosen = list(dict.fromkeys(int(np.argmax(candidates @ axis)) for axis in np.hstack([axes, -axes]).T))
    # A distance can only fall while the hull grows, so an old one is a bound: only the largest are computed anew.
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
        if len(chosen) >= min(MOST_VERTICES, len(candidates)) or -queue[0][0] <= tolerance:
            break
        chosen.append(queue[0][1])
    outside = _extreme(_outside(points, hull))
    return Fit(vertices, max((distance_from_hull(p, hull) for p in outside), default=0.0) + _ROUNDING)


def _extreme(points: Array) -> Array:
    """Return the corners of the hull of points: a distance from a convex set is convex, so the largest is at one."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(points[ConvexHull(points).vertices]) if len(points) > _FEW else points
    except QhullError:
        return points


def _outside(points: Array, hull: SweptHull) -> Array:
    """Return the points in front of a face, in parts so that a million of them need little memory."""
    if not len(hull.faces):
        return points
    corners = hull.vertices[hull.faces] - hull.center
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    parts = np.array_split(points - hull.center, -(-len(points) // _CHUNK))
    inside = [np.all(part @ (normals * np.sign(offsets)[:, None]).T <= np.abs(offsets), axis=1) for part in parts]
    return np.asarray(points[~np.concatenate(inside)])
