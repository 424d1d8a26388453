"""Friction pyramids of points and of flat soles as rows ``C f ≥ 0``; the first row is the normal force."""

from __future__ import annotations

import itertools

import numpy as np

from impact_posture.arrays import Array
from impact_posture.errors import ContactError


def point_cone(friction: float) -> Array:
    """Return ``f_z ≥ 0`` and ``|f_x|, |f_y| ≤ μ' f_z``, shape (5, 3), z along the normal.

    With ``μ' = μ/√2``, the pyramid lies inside the Coulomb cone.
    """
    mu = friction / np.sqrt(2)
    return np.array([[0, 0, 1], [-1, 0, mu], [1, 0, mu], [0, -1, mu], [0, 1, mu]], dtype=float)


def surface_cone(friction: float, half_x: float, half_y: float) -> Array:
    """Return the cone of wrenches that forces in the pyramids at the four corners make at a sole's center, (17, 6).

    The rows are ``f_z ≥ 0``, four rows of friction, four rows that keep the center of pressure on the sole, and
    eight rows that bound the yaw moment (Caron, Pham, Nakamura 2015, "Stability of surface contacts for humanoid
    robots", eq. 16 to 20):
    ``−μ(X+Y)f_z + |Y f_x − μ τ_x| + |X f_y − μ τ_y| ≤ τ_z ≤ μ(X+Y)f_z − |Y f_x + μ τ_x| − |X f_y + μ τ_y|``.
    """
    mu, x, y = friction / np.sqrt(2), half_x, half_y
    rows = np.zeros((17, 6))
    rows[:5, :3] = point_cone(friction)
    rows[5:9, 2] = (y, y, x, x)
    rows[5:9, 3:5] = [[1, 0], [-1, 0], [0, 1], [0, -1]]
    signs = list(itertools.product((1.0, -1.0), repeat=2))
    for k, (s, t) in enumerate(signs):
        rows[9 + k] = [-s * y, -t * x, mu * (x + y), s * mu, t * mu, 1]
        rows[13 + k] = [-s * y, -t * x, mu * (x + y), -s * mu, -t * mu, -1]
    return rows


def to_world(cone: Array, normal: Array, heading: Array) -> Array:
    """Return a cone in world axes, for forces (and moments): z is ``normal``, x the tangential part of ``heading``.

    Raises:
        ContactError: The heading of a sole points along the normal.
    """
    x = heading - normal * (normal @ heading)
    if np.linalg.norm(x) < 1e-6:
        if cone.shape[1] == 6:
            raise ContactError("the sole stands on its edge", where="contact", hint="put the sole on the ground")
        other = np.eye(3)[int(np.argmin(np.abs(normal)))]
        x = other - normal * (normal @ other)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(normal, x), normal])
    turned = cone.copy()
    for k in range(0, cone.shape[1], 3):
        turned[:, k : k + 3] = cone[:, k : k + 3] @ R.T
    return turned
