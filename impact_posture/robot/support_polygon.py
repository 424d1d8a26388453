"""Convex hulls in the plane, and the support polygon of feet on level ground."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from impact_posture.system.arrays import Array, nonnegative_least_squares

# A point within the distance ``ON_LINE`` (m) of a line is treated as on the line.  Edges are rounded to ``_DIGITS``
# decimals.
ON_LINE, _DIGITS = 1e-9, 12


def convex_ring(points: Array) -> list[int]:
    """Return the corners of the convex hull of points, shape (k, 2), as indices, counter-clockwise.

    The lower and the upper chain follow the sorted points and keep only left turns (A. M. Andrew, "Another efficient
    algorithm for convex hulls in two dimensions", Inf. Process. Lett. 1979).  SciPy is not used, because its import
    takes longer than solving a typical problem.
    """
    order = np.lexsort((points[:, 1], points[:, 0])).tolist()
    x, y = points[:, 0].tolist(), points[:, 1].tolist()
    corners: list[int] = []
    for chain in (order, order[::-1]):
        hull: list[int] = []
        for k in chain:
            while len(hull) > 1:
                a, b = hull[-2:]
                if (y[k] - y[a]) * (x[b] - x[a]) - (x[k] - x[a]) * (y[b] - y[a]) > 0:
                    break
                hull.pop()
            hull.append(k)
        corners += hull[:-1]
    return corners or order[:1]


def polygon_edges(points: Iterable[Array]) -> tuple[Array, Array] | None:
    """Return the edges ``n·p ≤ b`` of the convex hull of points, shape (2,) each, m; ``None`` if the area is zero.

    The edges are outward unit normals ``n``, shape (k, 2), and offsets ``b``, m, shape (k,).  A corner on the line
    between its neighbors is left out.
    """
    places = np.array(list(points), dtype=float).reshape(-1, 2)
    corners = [places[k] for k in convex_ring(places)]
    while len(corners) > 2:
        # If a corner of the hull is near the line through its neighbors, the corner lies between the neighbors.
        around = zip(np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0), corners, strict=True)
        heights = [_height(*points) for points in around]
        if min(heights) >= ON_LINE:
            break
        corners.pop(int(np.argmin(heights)))
    if len(corners) < 3:
        return None
    steps = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([steps[:, 1], -steps[:, 0]]) / np.linalg.norm(steps, axis=1)[:, None]
    offsets = (normals * corners).sum(axis=1)
    # Round and sort the edges, so that feet in another order give the same edges.
    edges = np.unique(np.round(np.column_stack([normals, offsets]), _DIGITS), axis=0)
    return edges[:, :2], edges[:, 2]


def nearest_in_hull(points: Array) -> Array:
    """Return the point nearest to zero in the convex hull of points, shape (k, d), m."""
    # The weights minimize |Σ w p|² + (Σ w − 1)².  The nearest point is Σ w p / Σ w.
    equations = np.vstack([points.T, np.ones(len(points))])
    weights = nonnegative_least_squares(equations, np.append(np.zeros(points.shape[1]), 1.0))
    return np.asarray(points.T @ weights / weights.sum())


def _height(start: Array, end: Array, point: Array) -> float:
    """Return the signed distance of a point from a line, m; positive on the right of the line."""
    along, off = end - start, point - start
    return float((along[1] * off[0] - along[0] * off[1]) / np.linalg.norm(along))
