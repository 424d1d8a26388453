"""The distance between two postures, its tangent gradient, and a constraint that bounds this distance."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.system.arrays import Array


def distance_squared(chart: Chart, q: Any, reference: Any) -> Any:
    """Return the squared distance of two configurations (``SX`` or ``DM``), approximately ``‖q ⊖ reference‖²``.

    The distance, in rad and m, is smooth everywhere.  A turn by Δ of a base, a ball joint or a continuous joint adds
    ``4 sin²(Δ/2) = 4 (1 − (quaternion·quaternion)²) = 2 (1 − cos Δ)``.  A change by Δ of any other coordinate adds
    Δ².
    """
    parts = []
    for slot in chart.slots:
        a, b = q[slot.q], reference[slot.q]
        if slot.kind.family in ("free-flyer", "spherical"):
            parts.append(4 * (1 - ca.dot(a[-4:], b[-4:]) ** 2))
            a, b = a[:-4], b[:-4]
        # For the cosine and sine of a continuous joint, this sum of squares is 2 (1 − cos Δ).
        parts.append(ca.sumsqr(a - b))
    return ca.sum1(ca.vertcat(*parts))


def distance(chart: Chart, q: Array, reference: Array) -> float:
    """Return the square root of :func:`distance_squared` for two configurations, shape (nq,)."""
    return float(np.sqrt(max(float(distance_squared(chart, ca.DM(q), ca.DM(reference))), 0.0)))


def distance_gradient(chart: Chart, q: Array, reference: Array) -> Array:
    """Return the tangent gradient of :func:`distance_squared` at ``q``, shape (nv,)."""
    gradient = np.zeros(chart.nv)
    for slot in chart.slots:
        a, b, family = q[slot.q], reference[slot.q], slot.kind.family
        if family in ("free-flyer", "spherical"):
            turn = pin.Quaternion(a[-4:])
            relative = pin.Quaternion(b[-4:]).inverse() * turn
            # d(4 (1 − w²)) = −8 w dw with dw = −½ v·ω.
            gradient[slot.v][-3:] = 4 * float(relative.w) * np.array(relative.coeffs()[:3])
            if family == "free-flyer":
                gradient[slot.v][:3] = 2 * turn.matrix().T @ (a[:3] - b[:3])
        elif family in ("continuous", "planar"):
            c, s = a[-2:]
            d = 2 * (a[:-2] - b[:-2])
            gradient[slot.v.stop - 1] = 2 * (s * b[-2] - c * b[-1])
            if family == "planar":
                gradient[slot.v][:2] = c * d[0] + s * d[1], -s * d[0] + c * d[1]
        else:
            gradient[slot.v] = 2 * (a - b)

    return gradient


class WithinDistance(ExpressionConstraint):
    """``distance_squared(q, reference) ≤ radius²``: the posture stays near the reference.

    The radius (> 0) is a row bound and the reference is a parameter, so one program serves all radii and references.
    """

    unit = "rad² (m²)"

    def __init__(self, chart: Chart, reference: Array, radius: float) -> None:
        self.name = "distance from the initial posture"
        self._chart = chart
        self.parameters = np.array(reference, dtype=float)
        self.lower, self.upper = np.array([-np.inf]), np.array([radius**2])

    def symbolic(self, tree: Tree, parameters: ca.SX) -> ca.SX:
        value: ca.SX = distance_squared(self._chart, tree.q, parameters)
        return value

    def evaluate(self, model: Numeric) -> tuple[Array, Array]:
        value = distance(self._chart, model.q, self.parameters) ** 2
        return np.array([value]), distance_gradient(self._chart, model.q, self.parameters)[None, :]
