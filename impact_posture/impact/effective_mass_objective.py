"""The effective mass with friction as an objective; at its minimum, the peak force is least."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import casadi as ca
import numpy as np

from impact_posture.impact.friction.coulomb_impact import coulomb_impact, impact_gradients
from impact_posture.impact.kinds.coulomb_kind import CoulombKind
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.lifted_form import UnknownJump
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array


class EffectiveMassKind(CoulombKind):
    """Effective mass with friction, ``m = nᵀp``, kg: the normal impulse per approach speed."""

    def value(self, q: Array) -> float:
        """Return the effective mass at ``q``, kg, computed with Pinocchio."""
        return coulomb_impact(self.oracle, q).mass

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return the gradient of the branch (stick or slide) at ``q``."""
        impact = coulomb_impact(self.oracle, q)
        gradients = impact_gradients(self.oracle, q, impact, np.zeros((1, self.case.robot.nv)), np.ones(1))
        return Subgradients(gradients, np.zeros(1))

    def lifted_value(self, jump: UnknownJump) -> ca.SX:
        """Return the unknown ``λ``, the normal part of the impulse."""
        return jump.variables[jump.a.numel() + jump.f.numel()]


class EffectiveMassObjective(WorstCaseObjective):
    """The effective mass, with friction, of the leading contact, kg; the peak force increases with this mass."""

    @staticmethod
    def of(objective: WorstCaseObjective) -> EffectiveMassObjective:
        """Return the effective mass of the leading contact of ``objective``, for the robot as modeled."""
        plain = replace(objective, kind="coulomb", normal_cone_deg=0.0, others=(), model_variants=())
        names = WorstCaseObjective.__dataclass_fields__
        return EffectiveMassObjective(**{name: getattr(plain, name) for name in names})

    @cached_property
    def impact_kind(self) -> EffectiveMassKind:
        """Formulas of the effective mass for the leading contact."""
        return EffectiveMassKind(self.oracle)

    @property
    def name(self) -> str:
        """Name in outputs."""
        return "effective mass"

    @property
    def structure(self) -> str:
        """Text that identifies the expressions."""
        return f"effective mass:{super().structure}"
