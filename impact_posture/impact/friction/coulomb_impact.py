"""Stick or slip: the impulse of one contact with Coulomb friction, in numbers and as CasADi expressions.

The contact point approaches along ``−n`` without tangential velocity.  While the normal impulse increases, the
contact point either sticks or slides along one fixed direction (:ref:`theory <coulomb>`).  Let ``B = JM⁻¹Jᵀ``;
``B_tt`` is the tangential part of ``B``, and ``g`` the tangential part of ``Bn``.  The impulse is a
multiple of ``n − w`` with

    ``(B_tt + σI) w = g``,  ``σ ≥ 0``,  ``‖w‖ ≤ μ``,  ``σ(μ − ‖w‖) = 0``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from impact_posture.dynamics.spatial import cross
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.sticking_point import ImpulseResponse, no_sticking
from impact_posture.system.arrays import Array

# An eigenvalue of B_tt below this fraction of the trace of B is regarded as zero.
_RANK = 1e-9
# Number of Newton steps for the equation 1/‖w‖ = 1/μ.  The steps converge from below.  In a test with 10⁵ random B of
# condition up to 10⁶, one B needed ten steps, and all others fewer.
_STEPS = 10
# The numeric iteration ends after this number of steps.
_MOST_STEPS = 60
# The numeric iteration also ends if the relative size of a step is below this value.
_ROUNDING = 1e-15
# A friction coefficient below this value is regarded as zero.
NO_FRICTION = 1e-15


@dataclass(frozen=True, eq=False)
class CoulombImpact:
    """One impact with friction, per unit approach speed and without rebound.

    Attributes:
        sticks: Whether the contact point sticks.
        jump: Velocity jump, shape (nv,).
        impulse: Impulse of the surface on the robot, world, shape (3,).
        slip: Velocity of the contact point after the impact, world axes, shape (3,); zero if the point sticks.
        sigma: Multiplier ``σ``, 1/kg; zero if the point sticks, infinite if there is no friction.
        mass: Effective mass with friction, ``m = nᵀp``, kg: the normal impulse per approach speed.  Without friction,
            ``m = 1/G``.  With friction, the impulse has a constant direction, so a linear contact spring is
            compressed as in a frictionless impact of the mass ``m``.
    """

    sticks: bool
    jump: Array
    impulse: Array
    slip: Array
    sigma: float
    mass: float


def coulomb_impact(oracle: ImpactOracle, q: Array, *, other: bool = False) -> CoulombImpact:
    """Compute the impact with the friction of the contact at ``q``, with Pinocchio.

    If ``other``, compute the other branch: sticking if the contact point would slide, and sliding with ``σ < 0`` if
    it would stick.

    Raises:
        MetricError: The result requires sticking, which does not exist at ``q``; or the other branch does not exist.
    """
    quantities, friction = oracle.quantities(q), oracle.contact.friction
    n, B = quantities.normal, quantities.mobility
    values, tangents = _tangential(n, B)
    g = tangents.T @ B @ n

    def excess(sigma: float) -> float:
        return float(np.linalg.norm(g / (values + sigma))) - friction

    if (excess(0.0) <= 0) != other:
        if quantities.sticking_impulse is None or quantities.sticking_jump is None:
            raise no_sticking()
        impulse = quantities.sticking_impulse
        return CoulombImpact(True, quantities.sticking_jump, impulse, np.zeros(3), 0.0, float(n @ impulse))
    w, sigma = np.zeros(3), np.inf
    if friction > NO_FRICTION:
        least = -float(values[0]) * (1 - _RANK) if other and values.size else 0.0
        if excess(least) < 0:
            raise no_sticking()
        sigma = _multiplier(values, g, friction, least)
        w = tangents @ (g / (values + sigma))
    mass = 1 / float(n @ B @ (n - w))
    impulse = mass * (n - w)
    return CoulombImpact(False, oracle.solve(oracle.J.T @ impulse), impulse, B @ impulse - n, sigma, mass)


def _tangential(n: Array, B: Array) -> tuple[Array, Array]:
    """Return the eigenvalues of ``B_tt`` that are not zero, and their axes (columns), world, shape (3, k)."""
    axes = np.linalg.svd(n[None, :])[2][1:].T
    values, vectors = np.linalg.eigh(axes.T @ B @ axes)
    kept = values > _RANK * np.trace(B)
    return values[kept], axes @ vectors[:, kept]


def _multiplier(values: Array, g: Array, friction: float, sigma: float) -> float:
    """Return the ``σ`` for which ``‖g/(values + σ)‖ = μ``.  The norm must exceed ``μ`` at ``σ = sigma``.

    The inverse of the norm is concave in ``σ``.  Newton's method for the inverse therefore converges from below
    without overshoot (Moré and Sorensen, Computing a Trust Region Step, 1983).  Importing a solver of SciPy would
    take 0.3 s.
    """
    for _ in range(_MOST_STEPS):
        w = g / (values + sigma)
        square = float(w @ w)
        step = square / float(w @ (w / (values + sigma))) * (math.sqrt(square) / friction - 1)
        if not step > _ROUNDING * abs(sigma):
            break
        sigma += step
    return sigma


def coulomb_gradient(oracle: ImpactOracle, q: Array, impact: CoulombImpact) -> Array:
    """Return the tangent gradient of ``C = ‖Δν‖²_W`` at unit approach speed, shape (nv,), of an impact at ``q``."""
    if impact.sticks or not np.isfinite(impact.sigma):
        return oracle.gradient_S(q) if impact.sticks else oracle.gradient_V(q)
    weighed = oracle.at(q).weigh(impact.jump)
    (gradient,) = impact_gradients(oracle, q, impact, 2 * weighed[None, :], np.zeros(1))
    return np.asarray(gradient + oracle.metric_gradient(impact.jump))


def impact_gradients(oracle: ImpactOracle, q: Array, impact: CoulombImpact, covectors: Array, shares: Array) -> Array:
    """Return the tangent gradient of ``cᵀΔν + s m`` for each covector ``c`` and factor ``s``, shape (k, nv).

    ``Δν`` is the jump of an impact at ``q``, and ``m`` is the effective mass of this impact.  ``covectors`` has shape
    (k, nv) and is constant; ``shares`` has shape (k,).  Let ``K`` be the matrix with ``∂w = K ∂B (n − w)``, and ``z =
    n − KBn``.  Then ``∂m = −m zᵀ∂B p`` and ``∂p = −(K + p zᵀ) ∂B p``, so each gradient is ``∂_q[cᵀM⁻¹Jᵀp − rᵀBp]``
    with fixed ``p`` and ``r = (K + z pᵀ)JM⁻¹c + s m z``, all in the axes ``normal_frame`` of the contact.
    """
    quantities, p = oracle.quantities(q), impact.impulse
    n, B = quantities.normal, quantities.mobility
    K = np.zeros((3, 3))
    if impact.sticks:
        values, tangents = _tangential(n, B)
        K = tangents / values @ tangents.T
    elif np.isfinite(impact.sigma):
        e = np.cross(n, p)
        K = np.outer(e, e) / (e @ B @ e + impact.sigma * e @ e)
    z = n - K @ B @ n
    r = (K + np.outer(z, p)) @ oracle.J @ oracle.solve(covectors.T) + impact.mass * np.outer(z, shares)
    x, y = oracle.respond(oracle.J.T @ p), oracle.respond(covectors.T - oracle.J.T @ r)
    turned, in_frame, rows = oracle.axes.T, oracle.case.in_contact_frame, list[Array]()
    for direction, a, f in zip(r.T, y.a.T, y.f.T, strict=True):
        gradient = oracle.coupling(turned @ p, a, in_frame) - oracle.coupling(turned @ direction, x.a, in_frame)
        rows.append(gradient - oracle.inertial(ImpulseResponse(a, f), x))
    return np.array(rows).reshape(len(shares), oracle.robot.nv)


def coulomb_direction(B: ca.SX, n: ca.SX, friction: float | ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return ``n − w``, shape (3,), and ``K``, shape (3, 3), for ``B``, a unit normal, and friction above zero.

    ``w = ((τ + σ)g − B_tt g)/(σ² + τσ + δ)`` with trace ``τ`` and determinant ``δ`` of ``B_tt``.  If ``B_tt`` is
    singular, as for planar robots, the point cannot move in one tangential direction.  The mobility in this direction
    is set to ``τ``.  This does not change ``w``, because ``g`` has no component in this direction.  At the transition
    between sticking and sliding, ``K`` is the matrix for sticking.
    """
    size, Bn, across = ca.trace(B), B @ n, ca.SX.eye(3) - n @ n.T
    g, trace = across @ Bn, size - ca.dot(n, Bn)
    Bg = across @ (B @ g)
    rows = [B[k, :].T for k in range(3)]
    determinant = ca.dot(n, ca.horzcat(*[cross(rows[k - 2], rows[k - 1]) for k in range(3)]) @ n)
    # A point that can only move along the normal has no friction force.
    fixed, flat = trace <= _RANK * size, determinant <= _RANK * size * trace
    determinant = ca.if_else(fixed, size**2, ca.if_else(flat, trace**2, determinant))
    trace = ca.if_else(fixed, 2 * size, ca.if_else(flat, 2 * trace, trace))
    g, Bg = g * (1 - fixed), Bg * (1 - fixed)
    length = ca.sqrt(ca.dot(g, g))
    sigma = ca.fmax(length / friction - trace, 0.0)
    for _ in range(_STEPS):
        u, D = (trace + sigma) * g - Bg, (trace + sigma) * sigma + determinant
        N = ca.dot(u, u)
        step = (D - ca.sqrt(N) / friction) / (trace + 2 * sigma - D * ca.dot(u, g) / N)
        sigma = ca.fmax(sigma - ca.if_else(length > 0, step, 0.0), 0.0)
    w = ((trace + sigma) * g - Bg) / ((trace + sigma) * sigma + determinant)
    e = cross(n, w)
    slid = e @ e.T / (ca.dot(e, B @ e) + sigma * ca.dot(e, e))
    return n - w, ca.if_else(sigma > 0, slid, (trace * across - across @ B @ across) / determinant)
