"""What the kinds without friction share: an impact at unit approach speed, whose impulse is unknown."""

from __future__ import annotations

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import ImpactKind
from impact_posture.impact.lifted import UnknownJump, impact_at, in_world, unknown_jump
from impact_posture.impact.oracle import ImpactQuantities


class FrictionlessKind(ImpactKind):
    """A kind of an impact at unit approach speed without friction, whose impulse ``λ`` is unknown."""

    def unknowns(self, case: ImpactCase, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return ``M a − J_sᵀf − λJᵀn = 0``, ``J_s a + εf = 0``, ``nᵀJa = 1``; ``λ`` is the last unknown."""
        impulse = ca.SX.sym(f"lam{label}")
        jump = unknown_jump(case, tree, impact_at(case, n * impulse), label)
        return jump.with_impulse(impulse, ca.dot(in_world(case, tree, n), jump.contact_velocity) - 1)

    def jump(self, found: ImpactQuantities) -> tuple[Array, Array]:
        """Return ``a/G`` and ``λ = 1/G``."""
        return found.jump / found.G, np.array([1 / found.G])
