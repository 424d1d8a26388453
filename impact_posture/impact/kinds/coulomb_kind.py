"""The objective type ``coulomb``: squared velocity jump per squared approach speed, with Coulomb friction."""

from __future__ import annotations

from contextlib import suppress

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree
from impact_posture.errors import MetricError
from impact_posture.impact.friction.coulomb_impact import (
    NO_FRICTION,
    coulomb_direction,
    coulomb_gradient,
    coulomb_impact,
)
from impact_posture.impact.kinds.impact_kind import ImpactKind
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.lifted_form import Guess, Lifted, UnknownJump, impact_at, in_world, unknown_jump
from impact_posture.system.arrays import Array

# Upper bound of κo, a product of two unknowns of :meth:`CoulombKind.unknowns`.  The exact product is zero, but the
# interior-point method needs a positive bound.
_CORNER = 1e-10


class CoulombKind(ImpactKind):
    """``C = ‖M⁻¹Jᵀp‖²_W/v²``: squared velocity jump per squared approach speed ``v``, with friction ``μ``.

    :mod:`impact_posture.impact.friction.coulomb_impact` computes the impulse ``p``.  ``C`` equals ``S`` if the
    contact point sticks, and equals ``V`` if there is no friction.  ``C`` is continuous in the posture, but its
    gradient is discontinuous (a kink) at postures where the contact point begins to slip.
    """

    name, symbol = "coulomb", "C"
    units = "jump² per (m/s)² of approach, with friction"
    kink = "where the contact point begins to slip, grad is the gradient of sticking"
    no_cone = (
        "the impact with friction is not a quadratic form of the normal, so its worst case over a cone is not known"
    )

    def value(self, q: Array) -> float:
        jump = coulomb_impact(self.oracle, q).jump
        return float(jump @ self.oracle.weigh(jump))

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the gradient of the actual branch (stick or slide), and of the other branch if it is relevant.

        The other branch is relevant if its value is at most ``within`` below ``C``.  If its value is above ``C``,
        then ``C`` is the smaller of two smooth functions.  The kink cannot then be a minimum, and the other branch is
        irrelevant.  At the kink, the gradient of sticking comes first.
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
        """Return ``C`` and its tangent gradient, shape (nv,), as expressions of the symbols in ``k``.

        At the kink, the gradient of sticking is returned.
        """
        case, n = self.case, k.n
        if case.contact.friction <= NO_FRICTION:
            return k.V, k.grad_V
        p, Bn, K = self.impulse(k)
        x = k.respond([impact_at(case, p)])
        value, R = k.product(x, x), in_world(case, k.tree, ca.SX.eye(3))
        r = -value * n - K @ (R.T @ k.adjoint_velocity(x) - value * Bn)
        return value, k.size_gradient(x, [impact_at(case, r)])

    def impulse(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return the impulse ``p`` per unit approach speed, ``Bn``, and ``K`` as in :func:`coulomb_direction`.

        The results are in the axes ``normal_frame`` of the contact, and ``B`` is the mobility ``JM⁻¹Jᵀ``.  The
        friction must be above zero.
        """
        R = in_world(self.case, k.tree, ca.SX.eye(3))
        B = R.T @ k.mobility @ R
        direction, K = coulomb_direction(B, k.n, self.case.contact.friction)
        return direction / ca.dot(B @ k.n, direction), B @ k.n, K

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return unknowns and equations for the velocity jump ``a`` that the impulse ``λ(n − μd)`` causes.

        The last unknowns are the normal impulse ``λ``, the slip direction ``d`` (``‖d‖ ≤ 1``, and 1 if the
        contact slides), the slip speed ``κ``, and ``o = 1 − ‖d‖²``.  The equations are ``M a − J_sᵀf − λJᵀ(n − μd)
        = 0``, ``J_s a + εf = 0``, ``nᵀJa = 1``, ``(Ja)_t = κd``.
        """
        case, size, d = self.case, ca.SX.sym(f"lam{label}"), ca.SX.sym(f"d{label}", 3)
        slip, inside = ca.SX.sym(f"kappa{label}"), ca.SX.sym(f"o{label}")
        jump = unknown_jump(case, tree, [impact_at(case, size * (n - case.contact.friction * d))], label)
        axes = in_world(case, tree, ca.SX.eye(3))
        moved = axes.T @ jump.contact_velocity
        along, out = ca.dot(n, moved), ca.dot(n, d)
        slides = moved - along * n - slip * (d - n * out) - n * out
        equations = ca.vertcat(along - 1, slides, inside + ca.dot(d, d) - 1)
        return jump.with_impulse(ca.vertcat(size, d, slip, inside), equations)

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the lifted form with the equations of :meth:`unknowns` and ``κ ≥ 0``, ``o ≥ 0``, ``κo = 0``."""
        jump = self.unknowns(tree, parameters)
        slip, inside = jump.variables[-2], jump.variables[-1]
        return Lifted.of([jump], self.lifted_value(jump), inequalities=[slip * inside - _CORNER])

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return the velocity jump with friction, and the unknowns ``λ``, ``d``, ``κ`` and ``o``."""
        oracle, friction = self.oracle, self.oracle.contact.friction
        impact = coulomb_impact(oracle, q)
        n, p = oracle.n, impact.impulse
        size, slip = float(n @ p), float(np.linalg.norm(impact.slip))
        d = (n - p / size) / friction if impact.sticks and friction > NO_FRICTION else impact.slip / max(slip, 1e-300)
        return impact.jump, np.array([size, *(oracle.axes.T @ d), slip, max(1 - float(d @ d), 0.0)])

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return values that solve the equations of :meth:`lift` at ``q``; ``κ`` and ``o`` have the lower bound 0."""
        guess = super().guess(q, scale, attempt)
        guess.lower[-2:] = 0.0
        return guess
