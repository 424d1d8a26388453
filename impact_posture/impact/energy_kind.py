"""The energy that the contact dissipates at a given approach speed: ``E = 1/(2G)``."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_kind import QuadraticKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Lifted, UnknownJump
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.impact.speed_kind import frictionless_jump, guess_frictionless

Vector = NDArray[np.float64]


class EnergyKind(QuadraticKind):
    """``E = 1/(2G)``; as a form of the normal ``K = −JM⁻¹Jᵀ``, whose largest value is where ``G`` is least."""

    name, symbol = "energy", "E"
    units = "J per (m/s)² of approach"

    def value(self, oracle: ImpactOracle, q: Vector) -> float:
        """``E``."""
        return oracle.quantities(q).E

    def gradient(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """``−∇G/(2G²)``."""
        return -oracle.gradient_G(q) / (2 * oracle.quantities(q).G ** 2)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """``E`` and its gradient."""
        return k.E, k.grad_E

    def lift(self, case: ImpactCase, tree: Tree, n: ca.SX) -> Lifted:
        """The equations of :func:`~impact_posture.impact.speed_kind.frictionless_jump`; the value is ``λ/2``."""
        jump, impulse, residual = frictionless_jump(case, tree, n)
        return Lifted(ca.vertcat(jump.variables, impulse), residual, impulse / 2)

    def guess(self, oracle: ImpactOracle, q: Vector) -> Vector:
        """See :func:`~impact_posture.impact.speed_kind.guess_frictionless`."""
        return guess_frictionless(oracle, q)

    def form(self, oracle: ImpactOracle, mobility: Vector, world: Vector, jumps: Vector) -> Vector:
        """``−JM⁻¹Jᵀ`` along the directions."""
        return np.asarray(-world.T @ mobility @ world)

    def form_gradient(self, oracle: ImpactOracle, q: Vector, n: Vector) -> Vector:
        """``−∇G`` along ``n``."""
        return -oracle.gradient_G(q, n)

    def form_expression(self, k: ImpactKernel) -> ca.SX:
        """``−JM⁻¹Jᵀ``."""
        return -k.mobility

    def of_form(self, case: ImpactCase, form: Vector) -> Vector:
        """``−1/(2K)``; infinite where the contact cannot move."""
        return np.asarray(np.where(form < 0, -1 / (2 * np.where(form < 0, form, -1.0)), np.inf))

    def of_form_slope(self, case: ImpactCase, form: Vector) -> Vector:
        """``1/(2K²)``."""
        return np.asarray(1 / (2 * form**2))

    def of_form_expression(self, case: ImpactCase, form: ca.SX) -> ca.SX:
        """``−1/(2K)``."""
        return -1 / (2 * form)

    def lift_entry(self, case: ImpactCase, world: ca.SX, one: UnknownJump, other: UnknownJump) -> ca.SX:
        """``−eᵀJa``."""
        return -ca.dot(world, other.contact_velocity)

    def form_unit(self, case: ImpactCase, value: Any) -> Any:
        """``1/(2E)``."""
        return 1 / (2 * value)
