"""The kinds of objective by name."""

from __future__ import annotations

from impact_posture.impact.coulomb_kind import CoulombKind
from impact_posture.impact.energy_kind import EnergyKind
from impact_posture.impact.impact_kind import ImpactKind
from impact_posture.impact.impulse_kind import ImpulseKind
from impact_posture.impact.speed_kind import SpeedKind
from impact_posture.impact.sticking_kind import StickingKind
from impact_posture.settings import ObjectiveKind

KINDS: dict[ObjectiveKind, type[ImpactKind]] = {
    "impulse": ImpulseKind,
    "speed": SpeedKind,
    "sticking": StickingKind,
    "coulomb": CoulombKind,
    "energy": EnergyKind,
}
