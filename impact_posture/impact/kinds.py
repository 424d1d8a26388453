"""The kinds of objective: a scalar of one impact along one normal, and the table of all of them by name."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.coulomb import CoulombKind
from impact_posture.impact.impact_kind import FrictionlessKind, ImpactKind, QuadraticKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import UnknownJump, impact_at, in_world, unknown_jump
from impact_posture.impact.oracle import SINGULAR, no_sticking
from impact_posture.settings import ObjectiveKind


class ImpulseKind(QuadraticKind):
    """``λ̄²H`` with ``H = nᵀΛ_c n``: the squared jump under the largest impulse.  The form is ``K = Λ_c``."""

    name, symbol = "impulse", "H"
    units = "(N·s)² × jump² per impulse²"
    adds_up = True

    @property
    def factor(self) -> float:
        """``λ̄²``."""
        return self.case.contact.impulse**2

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return ``M a − J_sᵀf − Jᵀn = 0``, ``J_s a + εf = 0``."""
        return unknown_jump(self.case, tree, impact_at(self.case, n), label)

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return ``a = M⁻¹Jᵀn``; no impulse is unknown."""
        return self.oracle.quantities(q).jump, np.zeros(0)

    def form_gradient(self, q: Array, n: Array) -> Array:
        """Return ``∇H`` along ``n``."""
        return self.oracle.gradient_H(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """Return ``Λ_c``."""
        return k.ellipsoid


class SpeedKind(FrictionlessKind):
    """``V = H/G²``: the squared jump at a given approach speed without friction."""

    name, symbol = "speed", "V"
    units = "jump² per (m/s)² of approach, frictionless"
    no_cone = "speed is H/G², no quadratic form of the normal: the exact worst case over a cone is not known for it"


class StickingKind(QuadraticKind):
    """``S = ‖M⁻¹Jᵀ(JM⁻¹Jᵀ)⁻¹n‖²_W``: the squared jump at a given approach speed of a contact point that sticks.

    The form is ``K = B⁻¹Λ_cB⁻¹`` with ``B = JM⁻¹Jᵀ``.
    """

    name, symbol = "sticking", "S"
    units = "jump² per (m/s)² of approach, no slip"
    unknown_impulse = True

    def unknowns(self, tree: Tree, n: ca.SX, label: str = "") -> UnknownJump:
        """Return ``M a − J_sᵀf − Jᵀs = 0``, ``J_s a + εf = 0``, ``J a = n``; ``s`` are the last unknowns."""
        impulse = ca.SX.sym(f"s{label}", 3)
        jump = unknown_jump(self.case, tree, Wrench(self.case.point, impulse, ca.SX.zeros(3)), label)
        return jump.with_impulse(impulse, jump.contact_velocity - in_world(self.case, tree, n))

    def jump(self, q: Array) -> tuple[Array, Array]:
        """Return jump and impulse ``s``; without friction where ``S`` does not exist."""
        found = self.oracle.quantities(q)
        if found.sticking_jump is None or found.sticking_impulse is None:
            return found.jump / found.G, found.normal / found.G
        return found.sticking_jump, found.sticking_impulse

    def directions(self, mobility: Array, world: Array) -> Array:
        """Return ``B⁻¹`` times the directions."""
        sizes = np.linalg.eigvalsh((mobility + mobility.T) / 2)
        if sizes[0] <= SINGULAR * sizes[-1]:
            raise no_sticking()
        return np.asarray(np.linalg.solve(mobility, world))

    def form_gradient(self, q: Array, n: Array) -> Array:
        """Return ``∇S`` along ``n``."""
        return self.oracle.gradient_S(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """Return ``B⁻¹Λ_cB⁻¹``."""
        return k.sticking_form


class EnergyKind(FrictionlessKind, QuadraticKind):
    """``E = 1/(2G)``: the energy that the contact dissipates at a given approach speed.

    The form is ``K = −JM⁻¹Jᵀ``, which is largest where ``G`` is least.
    """

    name, symbol = "energy", "E"
    units = "J per (m/s)² of approach"

    def lifted_value(self, jump: UnknownJump) -> ca.SX:
        """Return ``λ/2``."""
        return jump.variables[-1] / 2

    def form(self, mobility: Array, world: Array, jumps: Array) -> Array:
        """Return ``−JM⁻¹Jᵀ`` along the directions."""
        return np.asarray(-world.T @ mobility @ world)

    def form_gradient(self, q: Array, n: Array) -> Array:
        """Return ``−∇G`` along ``n``."""
        return -self.oracle.gradient_G(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """Return ``−JM⁻¹Jᵀ``."""
        return -k.mobility

    def of_form(self, form: Array) -> Array:
        """Return ``−1/(2K)``; infinite where the contact cannot move."""
        return np.asarray(np.where(form < 0, -1 / (2 * np.where(form < 0, form, -1.0)), np.inf))

    def of_form_slope(self, form: Array) -> Array:
        """Return ``1/(2K²)``."""
        return np.asarray(1 / (2 * form**2))

    def of_form_expression(self, form: ca.SX) -> ca.SX:
        """Return ``−1/(2K)``."""
        return -1 / (2 * form)

    def lift_direction(self, tree: Tree, n: ca.SX, label: str) -> UnknownJump:
        """Return the jump under the unit impulse along the direction."""
        return unknown_jump(self.case, tree, impact_at(self.case, n), label)

    def lift_entry(self, world: ca.SX, one: UnknownJump, other: UnknownJump) -> ca.SX:
        """Return ``−eᵀJa``."""
        return -ca.dot(world, other.contact_velocity)

    def form_unit(self, value: Any) -> Any:
        """Return ``1/(2E)``."""
        return 1 / (2 * value)


KINDS: dict[ObjectiveKind, type[ImpactKind]] = {
    "impulse": ImpulseKind,
    "speed": SpeedKind,
    "sticking": StickingKind,
    "coulomb": CoulombKind,
    "energy": EnergyKind,
}
