"""The worst normal of a cone as a CasADi expression, which the C export evaluates.

Choose the axes of the cone such that ``A = [a, bᵀ; b, diag(d₁, d₂)]`` with ``gap = d₁ − d₂ ≥ 0``.  There are two
cases.  In each case the normal follows from the root of a scalar function, to which Newton's method converges from
the left without overshoot:

- The normal is on the edge, ``n = (c, s w)``, ``|w| = 1``.  Then ``w_i = p_i/(ν − d_i)`` with ``p = b c/s``, and
  ``ν`` is the root of ``1/|w| = 1`` (a trust-region problem in the plane; Moré and Sorensen 1983).
- The normal is inside the cone, ``n ∝ (1, b_i/(λ − d_i))``.  Then ``λ`` is the largest eigenvalue, the root of
  ``λ − a = Σ b_i²/(λ − d_i)``.  The worst normal is inside the cone if and only if ``λ > ν``.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

# Numbers of Newton steps for a normal on the edge and for a normal inside the cone.  The normal then has full
# precision for cones up to 89.9° and for values of p, gap and a over 16 decades.
_EDGE_STEPS, _INSIDE_STEPS = 8, 14
# Divisor that replaces zero: smaller than all relevant values, but not zero in single precision.
_TINY = 1e-30


def cone_axes_symbolic(n: ca.SX) -> ca.SX:
    """Return :func:`~impact_posture.impact.worst_case.worst_normal.cone_axes` as an expression of ``n``."""
    x, y, z = n[0], n[1], n[2]
    side = ca.if_else(z >= 0, 1.0, -1.0)
    a = -1 / (side + z)
    b = x * y * a
    return ca.horzcat(n, ca.vertcat(1 + side * x * x * a, side * b, -side * x), ca.vertcat(b, side + y * y * a, -y))


def worst_normal_symbolic(A: ca.SX, axis: ca.SX, cone_deg: float) -> ca.SX:
    """Return the normal, shape (3,), that maximizes ``nᵀAn`` within ``cone_deg`` degrees of ``axis``.

    If several normals attain the maximum, one of them is returned.  Do not differentiate this expression: the
    gradient of the maximum is the gradient of ``nᵀA(q)n`` for a fixed ``n`` (Danskin's theorem).
    """
    alpha = np.deg2rad(cone_deg)
    c, s = float(np.cos(alpha)), float(np.sin(alpha))
    axes = cone_axes_symbolic(axis)
    P = axes.T @ A @ axes
    h, k = (P[1, 1] - P[2, 2]) / 2, P[1, 2]
    radius = ca.hypot(h, k)
    turn = ca.atan2(k, h) / 2
    turned = ca.blockcat([[ca.cos(turn), -ca.sin(turn)], [ca.sin(turn), ca.cos(turn)]])
    b = turned.T @ P[1:, 0]
    gap, above = 2 * radius, (P[1, 1] + P[2, 2]) / 2 + radius - P[0, 0]
    eta = _edge_root(b * (c / s), gap)
    w = _on_circle(b * (c / s), eta, gap)
    # The eigenvector is inside the cone only if the root of the secular function is above η, the root for the edge.
    is_edge = _secular(eta, above, b, gap)[0] >= 0
    xi = eta
    for _ in range(_INSIDE_STEPS):
        value, slope = _secular(xi, above, b, gap)
        xi = xi - ca.fmin(value, 0) / slope
    inside = ca.vertcat(1, b[0] / ca.fmax(xi, _TINY), b[1] / ca.fmax(xi + gap, _TINY))
    inside = inside / ca.norm_2(inside)
    edge = ca.vertcat(c, s * w)
    local = ca.vertcat(*[ca.if_else(is_edge, edge[i], inside[i]) for i in range(3)])
    return axes @ ca.vertcat(local[0], turned @ local[1:])


def _edge_root(p: ca.SX, gap: ca.SX) -> ca.SX:
    """Return ``η = ν − d₁ ≥ 0`` with ``p₁²/η² + p₂²/(η + gap)² = 1``; zero if ``p₁ = 0`` and ``|p₂| < gap``."""
    # Start at the largest lower bound.  The bound ``corner`` is for p₁ near zero and |p₂| near the gap: η ~ p₁^⅔.
    x, y = ca.fabs(p[0]), ca.fabs(p[1])
    corner = ca.fmin((x * x * gap / 4) ** (1 / 3), x * ca.sqrt(gap / (4 * ca.fmax(gap - y, 0) + _TINY)))
    eta = ca.fmax(ca.fmax(ca.fmax(x, y - gap), corner), _TINY)
    for _ in range(_EDGE_STEPS):
        x, y = p[0] / eta, p[1] / (eta + gap)
        square = x * x + y * y
        # The function 1/|w| − 1 is concave and increasing.  Newton's method from the left cannot overshoot its root.
        slope = x * x / eta + y * y / (eta + gap)
        step = square * (ca.sqrt(square) - 1) / ca.fmax(slope, _TINY)
        eta = eta + ca.fmax(step, 0)
    return eta


def _on_circle(p: ca.SX, eta: ca.SX, gap: ca.SX) -> ca.SX:
    """Return the unit vector ``w``.  If ``p₁ = 0``, both signs of its first entry are valid, and plus is used."""
    y = ca.fmin(ca.fmax(p[1] / ca.fmax(eta + gap, _TINY), -1), 1)
    rest = 1 - y * y
    # If the first entry is large, compute it by the square root.  If it is small, the square root loses digits, so
    # use the quotient.
    x = ca.if_else(rest > 1e-6, ca.if_else(p[0] >= 0, 1.0, -1.0) * ca.sqrt(rest), p[0] / eta)
    return ca.vertcat(x, y) / ca.hypot(x, y)


def _secular(xi: ca.SX, above: ca.SX, b: ca.SX, gap: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the secular function ``λ − a − Σ b_i²/(λ − d_i)`` at ``λ = d₁ + ξ``, and its derivative."""
    x, y = b[0] / ca.fmax(xi, _TINY), b[1] / ca.fmax(xi + gap, _TINY)
    return xi + above - b[0] * x - b[1] * y, 1 + x * x + y * y
