"""Contact point or sole of a foot, from the shapes of its URDF."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impact_posture.collision.contact_front import rigid_silhouettes
from impact_posture.config.demand import Vector3
from impact_posture.robot.guessed_parts import upright_frames
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.system.arrays import Array

# Points of a foot up to this height (m) above its lowest point are treated as touching the ground.
_PATCH = 5e-4
# A contact area narrower than this value (m) is treated as a point.  The contact area of a ball of 10 cm radius has
# this width.
_SOLE = 0.02
# Cosine of the largest tilt of a sole at the default posture, 10°.
_UPRIGHT = float(np.cos(np.radians(10.0)))
# Number of ratios of length to width that are tried for the rectangle in a sole.
_PROPORTIONS = 180


def support(robot: Robot, frame: str, *, flat: bool) -> Support:
    """Return a foot; the shapes that move with its frame determine its contact point or sole.

    A sole is flat, below its frame, and upright at the default posture.  The size of a sole is the largest rectangle
    around its middle inside the convex hull of its lowest points.  Any other foot touches the ground at its lowest
    point, and is a surface if ``flat`` is true, or else a point.
    """
    foot = Support(frame=frame, kind="surface" if flat else "point")
    sole = _lowest(robot, frame, np.array([0.0, 0.0, 1.0]))
    if not len(sole):
        return foot
    middle = (sole.min(axis=0) + sole.max(axis=0)) / 2
    measured = measured_sole(robot, replace(foot, kind="surface", offset=_rounded(middle)))
    lowest = _lowest(robot, frame, _up(robot, frame)).mean(axis=0)
    return measured if measured.has_sole else replace(foot, offset=_rounded(lowest))


def measured_sole(robot: Robot, foot: Support) -> Support:
    """Return a foot with the size of its sole around its contact point.

    A foot that is not flat, below its frame and upright is returned unchanged.
    """
    sole = _lowest(robot, foot.frame, np.array([0.0, 0.0, 1.0]))
    x, y, _ = _rounded(np.append(_inner_rectangle(sole[:, :2] - foot.offset[:2]), 0.0))
    upright = _up(robot, foot.frame)[2] > _UPRIGHT
    return replace(foot, size=(x, y)) if upright and min(x, y) >= _SOLE / 2 else foot


def _up(robot: Robot, frame: str) -> Array:
    """Return the upward direction at the default posture, in the axes of a frame, shape (3,)."""
    return np.asarray(upright_frames(robot).oMf[robot.frame_id(frame)].rotation[2])


def _rounded(point: Array) -> Vector3:
    x, y, z = (round(float(value), 4) + 0.0 for value in point)
    return x, y, z


def _lowest(robot: Robot, frame: str, up: Array) -> Array:
    """Return the lowest points of a foot along the direction ``up``, shape (3,), in the axes of its frame, (k, 3)."""
    carrier = robot.model.frames[robot.frame_id(frame)]
    R, p, joint = carrier.placement.rotation, carrier.placement.translation, int(carrier.parentJoint)
    shapes = [shape for shape in rigid_silhouettes(robot, joint) if shape.joint == joint]
    points = np.vstack([np.zeros((0, 3)), *((shape.foremost(R @ -up) - p) @ R for shape in shapes)])
    heights = points @ up
    return np.asarray(points[heights <= heights.min(initial=np.inf) + _PATCH])


def _inner_rectangle(points: Array) -> Array:
    """Return the half extents, m, of the largest rectangle around zero in the convex hull of points, shape (k, 2)."""
    edges = polygon_edges(points) if len(points) else None
    if edges is None or edges[1].min() <= 0:
        return np.zeros(2)
    angles = np.pi / 2 * np.arange(1, _PROPORTIONS) / _PROPORTIONS
    # Also try the proportions of rectangles with a corner at one of the points, so that a rectangular sole gives an
    # exact result.
    proportions = np.hstack([[np.cos(angles), np.sin(angles)], np.abs(points.T) + 1e-9])
    halves = proportions * (edges[1][:, None] / (np.abs(edges[0]) @ proportions)).min(axis=0)
    return np.asarray(halves[:, halves.prod(axis=0).argmax()])
