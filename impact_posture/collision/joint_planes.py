"""Bounds on the joints between two bodies whose hulls overlap at postures where the shapes do not touch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.config.cached_values import StoredArray
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

# ``_TRIED`` is the number of grid positions per joint.  ``_MOST_JOINTS`` is the largest number of joints between two
# bodies.
_TRIED, _MOST_JOINTS = 25, 3
# Half of the largest joint range for which planes are searched, rad (m).  With this range, the step of the grid is
# about half a radian.
_MOST_HALF = 6.5
# ``_MOST_PLANES`` is the largest number of planes for a pair of bodies.  A position is free if the shapes do not
# touch.  At least the fraction ``_LEFT`` of the free positions must satisfy all planes.
_MOST_PLANES, _LEFT = 12, 1 / 3
# The cost of a plane is the number of removed free positions, plus this fraction of all free positions.
_WORTH = 0.05


@dataclass(frozen=True, eq=False)
class JointPlanes:
    """Planes ``normals θ ≤ bounds`` for the one to three joints θ between two bodies.

    The shapes of the bodies do not touch if θ satisfies all planes.  ``normals``, shape (k, m), are in 1/rad (1/m if
    prismatic), and have no rows if the shapes never touch.
    """

    bodies: tuple[str, str]
    joints: tuple[str, ...]
    normals: StoredArray
    bounds: StoredArray


def joint_planes(
    robot: Robot, names: tuple[str, str], joints: tuple[int, int], touch: Callable[[pin.Data], bool]
) -> JointPlanes | None:
    """Return planes that keep the shapes of two bodies apart, or ``None`` if the search fails.

    The shapes are checked on a grid over the ranges of the joints between the bodies.  Planes remove the grid cells
    around the positions where the shapes touch.  Each step adds the plane with the highest ratio of removed touching
    positions to its cost (:data:`_WORTH`).  ``touch`` tells whether the shapes touch at given placements.
    """
    model, start = robot.model, robot.posture()
    lowest, highest = model.lowerPositionLimit, model.upperPositionLimit
    # The joints that move one body relative to the other, except joints with a range of zero.
    moving = sorted(set(model.supports[joints[0]]) ^ set(model.supports[joints[1]]))
    between = [k for k in moving if model.nqs[k] != 1 or lowest[model.idx_qs[k]] < highest[model.idx_qs[k]]]
    at = [model.idx_qs[k] for k in between]
    low, high = lowest[at], highest[at]
    half, single = (high - low) / 2, all(model.nqs[k] == 1 for k in between)
    if not (0 < len(between) <= _MOST_JOINTS and single and (half > 0).all() and (half <= _MOST_HALF).all()):
        return None
    data, q = model.createData(), start.copy()
    grid = np.array(list(product(*np.linspace(low, high, _TRIED).T)))

    def touches(theta: Array) -> bool:
        q[at] = theta
        pin.forwardKinematics(model, data, q)
        return touch(data)

    hit = np.array([touches(theta) for theta in grid])
    planes = _cut_off(hit, (grid - start[at]) / half, 2 / (_TRIED - 1))
    if planes is None:
        return None
    rows = planes[0] / half
    return JointPlanes(names, tuple(str(model.names[k]) for k in between), rows, planes[1] + rows @ start[at])


def _cut_off(hit: NDArray[np.bool_], positions: Array, step: float) -> tuple[Array, Array] | None:
    """Return normals, shape (k, m), and bounds of planes that separate all positions ``hit`` from the origin.

    ``positions``, shape (n, m), are relative to the default posture.  ``positions`` and ``step`` are divided by half
    the joint ranges.
    """
    free, left = positions[~hit], positions[hit]
    count = max(1, len(free))
    # Directions along each axis, and at equal angles to several axes.
    signs = np.array([signs for signs in product((-1, 0, 1), repeat=positions.shape[1]) if any(signs)], dtype=float)
    directions = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    # Extent along each direction of the grid cell around a position.
    cells = step * np.abs(directions).sum(axis=1)
    normals, bounds = [np.zeros((0, positions.shape[1]))], [np.zeros(0)]
    while len(left):
        heights = (left @ directions.T - cells).round(9)
        planes = [(k, bound) for k, along in enumerate(heights.T) for bound in np.unique(along) if bound > 0]
        if not planes or len(bounds) > _MOST_PLANES:
            return None
        costs = [np.sum(free @ directions[k] > bound) for k, bound in planes]
        worth = [
            np.sum(heights[:, k] >= bound) / (cost + _WORTH * count)
            for (k, bound), cost in zip(planes, costs, strict=True)
        ]
        k, bound = planes[int(np.argmax(worth))]
        normals.append(directions[[k]])
        bounds.append(np.array([bound]))
        free, left = free[free @ directions[k] <= bound], left[heights[:, k] < bound]
    return (np.vstack(normals), np.hstack(bounds)) if len(free) >= _LEFT * count else None
