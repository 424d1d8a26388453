"""Bounds on the joints between two bodies whose hulls cannot keep apart although their shapes can."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.robot.robot import Robot
from impact_posture.stored_text import StoredArray

# Positions of each joint at which shapes are tried.  More joints than this between two bodies are too many.
_TRIED, _MOST_JOINTS = 25, 2
# Most planes of a pair, and the least share of the free positions that they leave.
_MOST_PLANES, _LEFT = 8, 0.5


@dataclass(frozen=True, eq=False)
class JointPlanes:
    """Planes ``normals θ ≤ bounds`` for the joints between two bodies; beyond them their shapes may touch.

    Attributes:
        bodies: Names of the bodies.
        joints: Names of the joints between them, m of one or two.
        normals: Shape (k, m), per rad (m).
        bounds: Shape (k,).
    """

    bodies: tuple[str, str]
    joints: tuple[str, ...]
    normals: StoredArray
    bounds: StoredArray


def joint_planes(
    robot: Robot, names: tuple[str, str], ends: tuple[int, int], touch: Callable[[pin.Data], bool]
) -> JointPlanes | None:
    """Return planes that keep the shapes of two bodies apart; ``None`` if they touch nowhere, or no planes are found.

    The shapes are tried on a grid over the ranges of the joints.  Each plane cuts off the nearest position at which
    they touch, one step of the grid before it, at right angles to the line from the default posture (in shares of
    the ranges), until it cuts off all of them.

    Args:
        robot: The robot.
        names: Names of the bodies.
        ends: Their joints.
        touch: Whether the shapes touch at the placements in the data.
    """
    model, start = robot.model, robot.posture()
    between = _between(model, *ends)
    at = [model.idx_qs[k] for k in between]
    low, high = (np.asarray(limits)[at] for limits in (model.lowerPositionLimit, model.upperPositionLimit))
    half, single = (high - low) / 2, all(model.nqs[k] == 1 for k in between)
    if not (0 < len(between) <= _MOST_JOINTS and single and np.isfinite(half).all() and (half > 0).all()):
        return None
    data, q = model.createData(), start.copy()
    grid = np.array(list(product(*np.linspace(low, high, _TRIED).T)))

    def touches(theta: Array) -> bool:
        q[at] = theta
        pin.forwardKinematics(model, data, q)
        return touch(data)

    shares = (grid - start[at]) / half
    hit = np.array([touches(theta) for theta in grid])
    free, left = shares[~hit], shares[hit]
    step, count = 2 / (_TRIED - 1), len(free)
    normals, bounds = list[Array](), list[float]()
    while len(left):
        size = np.linalg.norm(left, axis=1)
        nearest = int(size.argmin())
        if size[nearest] <= step or len(normals) == _MOST_PLANES:
            return None
        normals.append(left[nearest] / size[nearest])
        bounds.append(float(size[nearest]) - step)
        free, left = (points[points @ normals[-1] <= bounds[-1]] for points in (free, left))
    if not normals or len(free) < _LEFT * count:
        return None
    rows = np.array(normals) / half
    return JointPlanes(names, tuple(str(model.names[k]) for k in between), rows, bounds + rows @ start[at])


def _between(model: pin.Model, first: int, second: int) -> list[int]:
    """Return the joints that move one of two joints' bodies against the other."""
    one, other = ({k for k in model.supports[end] if k} for end in (first, second))
    return sorted(one ^ other)
