"""Stick or slip: the impulse of one contact with Coulomb friction, in numbers and as expressions.

The contact point approaches along ``−n`` without tangential velocity.  While the normal impulse grows, the contact
point sticks, or it slides along one fixed direction (:ref:`theory <coulomb>`).  With ``B = JM⁻¹Jᵀ``, its tangential
part ``B_tt`` and ``g`` the tangential part of ``Bn``, the impulse is a multiple of ``n − w`` with

    ``(B_tt + σI) w = g``,  ``σ ≥ 0``,  ``‖w‖ ≤ μ``,  ``σ(μ − ‖w‖) = 0``.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.spatial import cross
from impact_posture.dynamics.tree import Tree
from impact_posture.errors import MetricError
from impact_posture.impact.impact_kind import ImpactKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Guess, Lifted, UnknownJump, impact_at, in_world, unknown_jump
from impact_posture.impact.oracle import ImpactOracle, no_sticking
from impact_posture.impact.worst_case import Subgradients

# An eigenvalue of B_tt below this share of the trace of B is zero.
_RANK = 1e-9
# Newton's method on 1/‖w‖ = 1/μ is monotone from its start.  Of 10⁵ random B with conditions up to 10⁶ one took ten.
_STEPS = 10
# Most of its steps in numbers, where they end at rounding.
_MOST_STEPS, _ROUNDING = 60, 1e-15
# Less friction than this changes no digit.
NO_FRICTION = 1e-15
# Slip times distance from the edge of the cone is zero, and at most this in the program, which needs an inside.
_CORNER = 1e-10


@dataclass(frozen=True, eq=False)
class CoulombImpact:
    """One impact with friction, per unit approach speed and without rebound.

    Attributes:
        sticks: Whether the contact point sticks.
        jump: Velocity jump, shape (nv,).
        impulse: Impulse of the surface on the robot, world, shape (3,).
        slip: Velocity of the contact point after the impact, world, shape (3,); zero if it sticks.
        sigma: ``σ``, 1/kg; zero if it sticks, infinite without friction.
    """

    sticks: bool
    jump: Array
    impulse: Array
    slip: Array
    sigma: float


def coulomb_impact(oracle: ImpactOracle, q: Array, *, other: bool = False) -> CoulombImpact:
    """Compute the impact with the friction of the contact at ``q``, from Pinocchio's numbers.

    With ``other``, compute the branch beyond the switch instead: sticking where it slides, sliding with ``σ < 0``.

    Raises:
        MetricError: The contact point has to stick and cannot, or the other branch does not reach this posture.
    """
    found, friction = oracle.quantities(q), oracle.contact.friction
    n, B = found.normal, found.mobility
    axes = np.linalg.svd(n[None, :])[2][1:].T
    values, vectors = np.linalg.eigh(axes.T @ B @ axes)
    kept = values > _RANK * np.trace(B)
    values, tangents = values[kept], axes @ vectors[:, kept]
    g = tangents.T @ B @ n

    def excess(sigma: float) -> float:
        return float(np.linalg.norm(g / (values + sigma))) - friction

    if (excess(0.0) <= 0) != other:
        if found.sticking_impulse is None or found.sticking_jump is None:
            raise no_sticking()
        return CoulombImpact(True, found.sticking_jump, found.sticking_impulse, np.zeros(3), 0.0)
    w, sigma = np.zeros(3), np.inf
    if friction > NO_FRICTION:
        least = -float(values[0]) * (1 - _RANK) if other and values.size else 0.0
        if excess(least) < 0:
            raise no_sticking()
        sigma = _multiplier(values, g, friction, least)
        w = tangents @ (g / (values + sigma))
    impulse = (n - w) / float(n @ B @ (n - w))
    return CoulombImpact(False, oracle.solve(oracle.J.T @ impulse), impulse, B @ impulse - n, sigma)


def _multiplier(values: Array, g: Array, friction: float, sigma: float) -> float:
    """Return the ``σ`` at which ``‖g/(values + σ)‖ = μ``, from one where the norm is larger.

    Newton's steps on the inverse of the norm, which is concave in ``σ``, come from below and do not pass the root
    (Moré and Sorensen, Computing a Trust Region Step, 1983).  SciPy's solvers would take 0.3 s to import.
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
    """Return the tangent gradient of ``C = ‖Δν‖²_W`` at unit approach speed, shape (nv,), of an impact at ``q``.

    With the impulse ``p`` and ``∂w = K ∂B (n − w)`` it is ``∂_q pᵀΛ_c p + 2 ∂_q rᵀBp`` for fixed ``p`` and
    ``r = −(Cn + K(JM⁻¹Wa − C Bn))``, all in the axes of the normal.
    """
    if impact.sticks or not np.isfinite(impact.sigma):
        return oracle.gradient_S(q) if impact.sticks else oracle.gradient_V(q)
    found, p, weighed = oracle.quantities(q), impact.impulse, oracle.weigh(impact.jump)
    n, B, value = found.normal, found.mobility, float(impact.jump @ weighed)
    e = np.cross(n, p)
    K = np.outer(e, e) / (e @ B @ e + impact.sigma * e @ e)
    r = -value * n - K @ (oracle.J @ oracle.solve(weighed) - value * B @ n)
    turned = oracle.axes.T
    step = float(np.linalg.norm(p) / np.linalg.norm(r))
    above, below = (oracle.gradient_G(q, turned @ (p + sign * step * r)) for sign in (1, -1))
    return np.asarray(oracle.gradient_H(q, turned @ p) + (above - below) / (2 * step))


def coulomb_direction(B: ca.SX, n: ca.SX, friction: float | ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return ``n − w``, shape (3,), and ``K``, shape (3, 3), for ``B``, a unit normal, and friction above zero.

    ``w = ((τ + σ)g − B_tt g)/(σ² + τσ + δ)`` with trace ``τ`` and determinant ``δ`` of ``B_tt``.  Where ``B_tt`` is
    singular, as in planar robots, the direction in which the point cannot move gets the mobility ``τ``, which
    changes nothing because ``g`` has no part along it.  ``K`` is that of sticking at the switch.
    """
    size, Bn, across = ca.trace(B), B @ n, ca.SX.eye(3) - n @ n.T
    g, trace = across @ Bn, size - ca.dot(n, Bn)
    Bg = across @ (B @ g)
    rows = [B[k, :].T for k in range(3)]
    determinant = ca.dot(n, ca.horzcat(*[cross(rows[k - 2], rows[k - 1]) for k in range(3)]) @ n)
    # A point that moves along the normal alone meets no friction.
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


class CoulombKind(ImpactKind):
    """``C = ‖M⁻¹Jᵀp‖²_W/v²``: the squared jump at a given approach speed with the friction ``μ`` of the contact.

    The impulse ``p`` is that of :func:`coulomb_impact`.  ``C`` is ``S`` where the contact point sticks,
    and ``V`` without friction.  It is continuous, with a kink where the contact point begins to slip.
    """

    name, symbol = "coulomb", "C"
    units = "jump² per (m/s)² of approach, with friction"
    kink = "where the contact point begins to slip, grad is that of sticking"
    no_cone = "coulomb is no quadratic form of the normal: the exact worst case over a cone is not known for it"

    def value(self, q: Array) -> float:
        """Return the value from Pinocchio's numbers; see the base for errors."""
        jump = coulomb_impact(self.oracle, q).jump
        return float(jump @ self.oracle.weigh(jump))

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the gradient, and that of the other branch where both nearly tie and the value is the larger.

        The first is that of sticking at the kink.  Where the value is the smaller of both, no optimum lies there.
        """
        oracle, sides = self.oracle, [coulomb_impact(self.oracle, q)]
        if within > 0:
            with suppress(MetricError):
                sides.append(coulomb_impact(oracle, q, other=True))
        values = np.array([side.jump @ oracle.weigh(side.jump) for side in sides])
        gaps = values[0] - values
        near = [k for k, gap in enumerate(gaps) if k == 0 or 0 <= gap <= within]
        return Subgradients(np.array([coulomb_gradient(oracle, q, sides[k]) for k in near]), gaps[near])

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and tangent gradient (nv) in the symbols of a kernel; at the kink, that of sticking."""
        case, n = self.case, k.n
        if case.contact.friction <= NO_FRICTION:
            return k.V, k.grad_V
        R = in_world(case, k.tree, ca.SX.eye(3))
        B = R.T @ k.mobility @ R
        direction, K = coulomb_direction(B, n, case.contact.friction)
        x = k.answer([impact_at(case, direction / ca.dot(B @ n, direction))])
        value = k.product(x, x)
        r = -value * n - K @ (R.T @ k.adjoint_velocity(x) - value * (B @ n))
        return value, k.size_gradient(x, impact_at(case, r))

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return the jump under ``λ(n − μd)``; the last unknowns are ``λ``, ``d``, ``κ`` (slip) and ``o = 1 − ‖d‖²``.

        ``M a − J_sᵀf − λJᵀ(n − μd) = 0``, ``J_s a + εf = 0``, ``nᵀJa = 1``, ``(Ja)_t = κd``.
        """
        case, size, d = self.case, ca.SX.sym(f"lam{label}"), ca.SX.sym(f"d{label}", 3)
        slip, inside = ca.SX.sym(f"kappa{label}"), ca.SX.sym(f"o{label}")
        jump = unknown_jump(case, tree, impact_at(case, size * (n - case.contact.friction * d)), label)
        axes = in_world(case, tree, ca.SX.eye(3))
        moved = axes.T @ jump.contact_velocity
        along, out = ca.dot(n, moved), ca.dot(n, d)
        slides = moved - along * n - slip * (d - n * out) - n * out
        equations = ca.vertcat(along - 1, slides, inside + ca.dot(d, d) - 1)
        return jump.with_impulse(ca.vertcat(size, d, slip, inside), equations)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the value under the equations of :meth:`unknowns` and ``κ ≥ 0``, ``o ≥ 0``, ``κo = 0``."""
        jump = self.unknowns(tree, parameters)
        slip, inside = jump.variables[-2], jump.variables[-1]
        return Lifted(jump.variables, jump.residual, self.lifted_value(jump), slip * inside - _CORNER)

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return the jump with friction, and ``λ``, ``d``, ``κ`` and ``o``."""
        oracle, friction = self.oracle, self.oracle.contact.friction
        found = coulomb_impact(oracle, q)
        n, p = oracle.n, found.impulse
        size, slip = float(n @ p), float(np.linalg.norm(found.slip))
        d = (n - p / size) / friction if found.sticks and friction > NO_FRICTION else found.slip / max(slip, 1e-300)
        return found.jump, np.array([size, *(oracle.axes.T @ d), slip, max(1 - float(d @ d), 0.0)])

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return the unknowns of :meth:`lift` that solve its equations at ``q``; ``κ`` and ``o`` are ≥ 0."""
        guess = super().guess(q, scale, attempt)
        guess.lower[-2:] = 0.0
        return guess
