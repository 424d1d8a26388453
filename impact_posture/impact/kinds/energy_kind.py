"""The objective type ``energy``: energy that the contact dissipates per squared approach speed."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.kinds.impact_kind import FrictionlessKind, QuadraticKind
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.lifted_form import UnknownJump, impact_at, unknown_jump
from impact_posture.system.arrays import Array


class EnergyKind(FrictionlessKind, QuadraticKind):
    """``E = 1/(2G)``: energy that the contact dissipates per squared approach speed.

    The quadratic form ``nᵀKn`` of :class:`QuadraticKind` has ``K = −JM⁻¹Jᵀ``.  The form equals ``−G``.
    """

    name, symbol = "energy", "E"
    units = "J per (m/s)² of approach"

    def lifted_value(self, jump: UnknownJump) -> ca.SX:
        """Return ``E = λ/2``, because the last unknown is ``λ = 1/G``."""
        return jump.variables[-1] / 2

    def form(self, mobility: Array, world: Array, jumps: Array) -> Array:
        return np.asarray(-world.T @ mobility @ world)

    def form_gradient(self, q: Array, n: Array) -> Array:
        return -self.oracle.gradient_G(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        return -k.mobility

    def of_form(self, form: Array) -> Array:
        """Return ``E`` for each ``form = −G``; infinite if ``G = 0`` (immovable contact)."""
        return np.asarray(np.where(form < 0, -1 / (2 * np.where(form < 0, form, -1.0)), np.inf))

    def of_form_slope(self, form: Array) -> Array:
        return np.asarray(1 / (2 * form**2))

    def of_form_expression(self, form: ca.SX) -> ca.SX:
        return -1 / (2 * form)

    def lift_direction(self, tree: Tree, n: ca.SX, label: str) -> UnknownJump:
        return unknown_jump(self.case, tree, [impact_at(self.case, n)], label)

    def lift_entry(self, world: ca.SX, first: UnknownJump, second: UnknownJump) -> ca.SX:
        return -ca.dot(world, second.contact_velocity)

    def form_unit(self, value: Any) -> Any:
        return 1 / (2 * value)
