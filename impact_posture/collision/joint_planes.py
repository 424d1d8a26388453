"""Bounds on the joints between two bodies whose hulls cannot keep apart although their shapes can."""

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

# Positions of each joint at which shapes are tried.  More joints than this between two bodies are too many.
_TRIED, _MOST_JOINTS = 25, 3
# Half of the largest range of a joint, rad (m), so that neighbors on the grid are half a radian apart at most.
_MOST_HALF = 6.5
# Most planes of a pair, and the least share of the free positions that they leave.
_MOST_PLANES, _LEFT = 12, 1 / 3
# A plane costs the free positions that it cuts off, and this share of all free positions for itself.
_WORTH = 0.05


@dataclass(frozen=True, eq=False)
class JointPlanes:
    """Planes ``normals θ ≤ bounds`` for the joints between two bodies; within them their shapes do not touch.

    Attributes:
        bodies: Names of the bodies.
        joints: Names of the joints between them, m of one to three.
        normals: Shape (k, m), per rad (m); no rows if the shapes touch nowhere.
        bounds: Shape (k,).
    """

    bodies: tuple[str, str]
    joints: tuple[str, ...]
    normals: StoredArray
    bounds: StoredArray


def joint_planes(
    robot: Robot, names: tuple[str, str], ends: tuple[int, int], touch: Callable[[pin.Data], bool]
) -> JointPlanes | None:
    """Return planes that keep the shapes of two bodies apart; ``None`` if none are found.

    The shapes are tried on a grid over the ranges of the joints.  Planes cut off the positions at which they touch,
    with the cells of the grid around them: each time the one that cuts off most of them for the free positions that
    it costs.

    Args:
        robot: The robot.
        names: Names of the bodies.
        ends: Their joints.
        touch: Whether the shapes touch at the placements in the data.
    """
    model, start = robot.model, robot.posture()
    lowest, highest = model.lowerPositionLimit, model.upperPositionLimit
    # A joint without a range stays where it starts.
    between = [
        k for k in _between(model, *ends) if model.nqs[k] != 1 or lowest[model.idx_qs[k]] < highest[model.idx_qs[k]]
    ]
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
    found = _cut_off(hit, (grid - start[at]) / half, 2 / (_TRIED - 1))
    if found is None:
        return None
    rows = found[0] / half
    return JointPlanes(names, tuple(str(model.names[k]) for k in between), rows, found[1] + rows @ start[at])


def _cut_off(hit: NDArray[np.bool_], shares: Array, step: float) -> tuple[Array, Array] | None:
    """Return normals, shape (k, m), and bounds of planes that cut off the positions hit, but not the origin.

    Args:
        hit: Whether the shapes touch at each position.
        shares: Positions, measured from the default posture in shares of half the ranges, shape (n, m).
        step: Step of the grid.
    """
    free, left = shares[~hit], shares[hit]
    count = max(1, len(free))
    # Along each axis, and between axes.
    signs = np.array([signs for signs in product((-1, 0, 1), repeat=shares.shape[1]) if any(signs)], dtype=float)
    directions = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    # The cells around a position reach so far along each direction.
    cells = step * np.abs(directions).sum(axis=1)
    normals, bounds = [np.zeros((0, shares.shape[1]))], [np.zeros(0)]
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


def _between(model: pin.Model, first: int, second: int) -> list[int]:
    """Return the joints that move one of two joints' bodies against the other."""
    one, other = ({k for k in model.supports[end] if k} for end in (first, second))
    return sorted(one ^ other)
