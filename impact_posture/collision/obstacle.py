"""Obstacles in the world as swept hulls."""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin

from impact_posture.collision.swept_hull import SweptHull
from impact_posture.obstacle import Obstacle


def obstacle_hull(obstacle: Obstacle) -> SweptHull:
    """Return a box or a ball as a swept hull in the world."""
    name, center = obstacle.name, np.array(obstacle.position)
    if obstacle.box is None:
        return SweptHull(name, name, 0, center[None], float(obstacle.sphere or 0.0))
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * obstacle.box
    x, y, z, w = np.array(obstacle.quaternion) / np.linalg.norm(obstacle.quaternion)
    return SweptHull(name, name, 0, center + corners @ pin.Quaternion(w, x, y, z).matrix().T, 0.0)
