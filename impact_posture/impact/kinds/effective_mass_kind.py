"""The objective type ``effective-mass``: normal impulse per approach speed, also called reflected mass."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.errors import MetricError
from impact_posture.impact.friction.coulomb_impact import NO_FRICTION, coulomb_impact, impact_gradients
from impact_posture.impact.kinds.coulomb_kind import CoulombKind
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.lifted_form import UnknownJump, impact_at
from impact_posture.system.arrays import Array


class EffectiveMassKind(CoulombKind):
    """Effective mass ``m = nᵀp``, kg: the normal impulse per unit approach speed, with friction ``μ``.

    The peak force of the impact increases with ``m``.  Without friction, ``m = 1/G = 1/(nᵀJM⁻¹Jᵀn)`` is the
    effective or reflected mass along ``n`` (Khatib, Inertial properties in robotic manipulation, 1995).  With
    friction, ``m`` is the smaller of the values for sticking and for sliding, so a kink cannot be a minimum.
    """

    name, symbol = "effective-mass", "m"
    units = "kg, with friction"

    def value(self, q: Array) -> float:
        """Return the effective mass at ``q``, kg, computed with Pinocchio.

        Raises:
            MetricError: The contact point cannot move along the normal without a slip that friction prevents.
        """
        if self.oracle.quantities(q).blocked:
            raise MetricError("is unbounded", where="effective mass", hint="the contact cannot move along the normal")
        return coulomb_impact(self.oracle, q).mass

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the gradient of the branch (stick or slide) at ``q``."""
        impact = coulomb_impact(self.oracle, q)
        gradients = impact_gradients(self.oracle, q, impact, np.zeros((1, self.case.robot.nv)), np.ones(1))
        return Subgradients(gradients, np.zeros(1))

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return ``m`` and its tangent gradient ``−m zᵀ∂B p`` with ``z = n − KBn``, shape (nv,)."""
        if self.case.contact.friction <= NO_FRICTION:
            return 1 / k.G, -k.grad_G / k.G**2
        p, Bn, K = self.impulse(k)
        m = ca.dot(k.n, p)
        x, z = (k.respond([impact_at(self.case, impulse)]) for impulse in (p, m * (k.n - K @ Bn)))
        return m, -k.tree.pair_gradient(x, z)

    def lifted_value(self, jump: UnknownJump) -> ca.SX:
        """Return the unknown ``λ``, the normal part of the impulse."""
        return jump.variables[jump.a.numel() + jump.f.numel()]
