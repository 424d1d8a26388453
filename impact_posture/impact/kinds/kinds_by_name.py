"""The class of each objective type, by name."""

from __future__ import annotations

from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.impact.kinds.coulomb_kind import CoulombKind
from impact_posture.impact.kinds.effective_mass_kind import EffectiveMassKind
from impact_posture.impact.kinds.energy_kind import EnergyKind
from impact_posture.impact.kinds.impact_kind import ImpactKind
from impact_posture.impact.kinds.impulse_kind import ImpulseKind
from impact_posture.impact.kinds.speed_kind import SpeedKind
from impact_posture.impact.kinds.sticking_kind import StickingKind

KINDS: dict[ObjectiveKind, type[ImpactKind]] = {
    "impulse": ImpulseKind,
    "speed": SpeedKind,
    "sticking": StickingKind,
    "coulomb": CoulombKind,
    "energy": EnergyKind,
    "effective-mass": EffectiveMassKind,
}
