"""Compression time and peak force of a contact, and the inertia at the joints that responds to it.

An effective mass ``m = 1/G`` that meets a contact at the speed v comes to rest after the time T.  The compression δ
and the force are largest at T, with the peak force F:

- linear contact, ``f = kδ``: ``T = (π/2)√(m/k)``, ``F = v√(km)``;
- Hertzian contact, ``f = κδ^{3/2}`` (Johnson, Contact Mechanics, 1985, §11.4): ``δ = (5mv²/4κ)^{2/5}``,
  ``F = κδ^{3/2}``, ``T = 1.472 δ/v``;
- contact of known T: the linear contact with this T, ``F = (π/2) mv/T``.

The ratio ``x = T √(G/C)`` decides whether the rotors behind elastic transmissions take part.  It is T in units of the
time in which the springs respond, with ``G = jM⁻¹jᵀ`` of the links alone, ``C = jK⁻¹jᵀ`` of the joint springs, and
``j = nᵀJ``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import gamma, pi, sqrt

import numpy as np

from impact_posture.config.problem_settings import MATERIALS, JointModel
from impact_posture.errors import InputError
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.joint_model import with_joint_model
from impact_posture.system.arrays import Array

# ∫₀¹ dz/√(1 − z^{5/2}): the time T in units of δ/v for the force κδ^{3/2}.
HERTZ_TIME = sqrt(pi) * gamma(7 / 5) / gamma(9 / 10)
# Radius of the steel tip that touches a material, m.
TIP_RADIUS = 0.01
# Up to the first x only the links respond, from the second x also the rotors (docs: which inertia).
SHORT, LONG = 0.2, 0.75


@dataclass(frozen=True)
class ContactStiffness:
    """The elasticity of a contact, by exactly one of three numbers.

    Attributes:
        linear: k, N/m.
        hertz: κ, N/m^{3/2}.
        duration: T, the time from touch to greatest compression, s.
        material: Name of the material with this κ, or empty.
    """

    linear: float | None = None
    hertz: float | None = None
    duration: float | None = None
    material: str = ""

    @staticmethod
    def of(stiffness: float | str | None, duration: float | None) -> ContactStiffness | None:
        """Return the contact of the settings ``contact_stiffness`` and ``contact_duration``; ``None`` without both.

        Raises:
            InputError: Both are given.
        """
        if stiffness is not None and duration is not None:
            raise InputError("follows from `contact_stiffness`", where="contact_duration", hint="give one of the two")
        if duration is not None:
            return ContactStiffness(duration=duration)
        if isinstance(stiffness, str):
            return ContactStiffness(hertz=hertz_stiffness(stiffness), material=stiffness)
        return None if stiffness is None else ContactStiffness(linear=stiffness)

    def compression_time(self, G: float, speed: float) -> float:
        """Return T, s, of a contact with ``G = 1/m`` (1/kg) at the approach speed (m/s)."""
        if self.duration is not None:
            return self.duration
        if self.linear is not None:
            return pi / 2 / sqrt(self.linear * G)
        return HERTZ_TIME * self._depth(G, speed) / speed if speed > 0 else float("inf")

    def peak_force(self, G: float, speed: float) -> float:
        """Return the force at greatest compression, N."""
        if self.duration is not None:
            return pi / 2 * speed / (G * self.duration)
        if self.linear is not None:
            return speed * sqrt(self.linear / G)
        return float((self.hertz or 0.0) * self._depth(G, speed) ** 1.5)

    def _depth(self, G: float, speed: float) -> float:
        """Return the greatest compression of a Hertzian contact, m."""
        return float((5 * speed**2 / (4 * (self.hertz or 0.0) * G)) ** 0.4)

    def linear_stiffness(self, G: float, speed: float) -> float:
        """Return k, N/m, of the linear contact with the same compression time."""
        return self.linear or (pi / 2 / self.compression_time(G, speed)) ** 2 / G

    def least_mobility(self, force: float, speed: float) -> float:
        """Return the least G, 1/kg, with which the peak force stays at most ``force``."""
        # The peak force is proportional to G^(−power).
        power = 1.0 if self.duration is not None else 0.5 if self.linear is not None else 0.6
        return float((self.peak_force(1.0, speed) / force) ** (1 / power))

    @property
    def words(self) -> str:
        """The contact as text."""
        if self.duration is not None:
            return f"compressed within {1e3 * self.duration:.3g} ms"
        if self.linear is not None:
            return f"{self.linear:.3g} N/m"
        return f"steel tip of {1e3 * TIP_RADIUS:g} mm radius on {self.material}"

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        numbers = {"stiffness": self.linear, "hertz_stiffness": self.hertz, "duration": self.duration}
        return {**numbers, "material": self.material or None}


def hertz_stiffness(material: str) -> float:
    """Return ``κ = (4/3) E* √R`` of a steel tip on a material, N/m^{3/2} (Johnson 1985, §4.2)."""
    inverse = sum((1 - nu**2) / E for E, nu in (MATERIALS["steel"], MATERIALS[material]))
    return 4 / 3 / inverse * sqrt(TIP_RADIUS)


@dataclass(frozen=True)
class Compression:
    """Effects of the elasticity of contact and joints.

    Attributes:
        contact: The contact; ``None`` if its elasticity is not known.
        time: T with the inertia of the objective's joint model, s; ``None`` without a contact.
        peak_force: Peak force F with this inertia, N; ``None`` without a contact.
        x: ``T √(G/C)`` with T and G of the links alone; ``None`` without a contact or without known springs.
        by_material: x of each material in the table, if springs are known and the contact is not; else empty.
        joint_model: The joint model of the objective.
    """

    contact: ContactStiffness | None
    time: float | None
    peak_force: float | None
    x: float | None
    by_material: dict[str, float]
    joint_model: JointModel

    @property
    def fitting(self) -> JointModel | None:
        """The joint model that fits x; ``None`` between the two, or where x is not known."""
        if self.x is None or SHORT < self.x < LONG:
            return None
        return "link" if self.x <= SHORT else "reflected"

    @property
    def line(self) -> str:
        """The meaning of x as text; empty where x is not known."""
        if self.x is None:
            if not self.by_material:
                return ""
            each = ", ".join(f"{float(f'{x:.2g}'):g} on {name}" for name, x in self.by_material.items())
            return f"x = {each} (an impact meets the links alone up to {SHORT:g}, links and rotors from {LONG:g})"
        if self.fitting == "link":
            meaning = "the contact is over before the rotors move: joint model 'link'"
        elif self.fitting == "reflected":
            meaning = "the rotors move with the links: joint model 'reflected'"
        else:
            used = self.joint_model == "elastic"
            advice = "'elastic', as here, is" if used else "evaluate with `joint_model` elastic"
            meaning = f"neither 'link' nor 'reflected' is right; {advice}"
        return f"x = {self.x:.2g}: {meaning}"

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return {
            "contact": None if self.contact is None else self.contact.to_dict(),
            "compression_time": self.time,
            "peak_force": self.peak_force,
            "x": self.x,
            "x_by_material": self.by_material,
            "fitting_joint_model": self.fitting,
            "line": self.line,
        }


def compression(
    objective: WorstCaseObjective, q: Array, speed: float, contact: ContactStiffness | None
) -> Compression | None:
    """Return T, peak force and x of the impact at the leading contact; ``None`` if all of them are unknown.

    ``q`` has shape (nq,), and ``speed`` is the approach speed, m/s.  Without a ``contact``, x is for each material.
    """
    springs = springs_along(objective.case, q)
    quantities = objective.oracle.quantities(q)
    if (contact is None and springs is None) or quantities.blocked:
        return None
    time = force = x = None
    by_material: dict[str, float] = {}
    if contact is not None:
        numbers = contact.compression_time(quantities.G, speed), contact.peak_force(quantities.G, speed)
        time, force = (value if np.isfinite(value) else None for value in numbers)
    if springs is not None:
        G, C = springs
        if contact is not None:
            x = contact.compression_time(G, speed) * sqrt(G / C)
        elif speed > 0:
            each = {name: ContactStiffness(hertz=hertz_stiffness(name)) for name in MATERIALS}
            by_material = {name: steel.compression_time(G, speed) * sqrt(G / C) for name, steel in each.items()}
    if x is not None and not np.isfinite(x):
        x = None
    return Compression(contact, time, force, x, by_material, objective.robot.joint_model)


def springs_along(case: ImpactCase, q: Array) -> tuple[float, float] | None:
    """Return ``G = jM⁻¹jᵀ`` of the links alone, 1/kg, and ``C = jK⁻¹jᵀ`` of the joint springs, m/N.

    ``None`` if no spring of known stiffness yields to the contact.
    """
    try:
        compliance = ElasticImpact(case).compliance(q)
    except InputError:
        return None
    links = replace(case, robot=with_joint_model(case.robot, "link"))
    return (ImpactOracle(links).quantities(q).G, compliance) if compliance > 0 else None


def both_models(objective: WorstCaseObjective) -> dict[JointModel, WorstCaseObjective]:
    """Return the same objective for the links alone and for links with rotors."""
    names: tuple[JointModel, ...] = ("link", "reflected")
    return {name: replace(objective, robot=with_joint_model(objective.robot, name)) for name in names}
