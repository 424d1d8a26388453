"""Compression time and peak force of a contact, and a ratio that tells whether the rotors respond to the impact.

An effective mass ``m`` that meets a contact at the speed v comes to rest after the time T.  At T, the compression δ
and the normal force reach their maxima; the largest force is F:

- linear contact, ``f = kδ``: ``T = (π/2)√(m/k)``, ``F = v√(km)``;
- Hertzian contact, ``f = κδ^{3/2}`` (Johnson, Contact Mechanics, 1985, §11.4): ``δ = (5mv²/4κ)^{2/5}``,
  ``F = κδ^{3/2}``, ``T = 1.472 δ/v``;
- contact of known T: treated as the linear contact with this T, ``F = (π/2) mv/T``.

The mass is ``m = nᵀp/v`` with the impulse p of the plastic impact at the friction of the contact
(:mod:`impact_posture.impact.friction.coulomb_impact`).  While the normal force grows, the point sticks or slides
along one constant direction.  The friction force is therefore proportional to the normal force, and the mass ``m`` is
exact.

The ratio ``x = T/√(m C)`` determines whether the rotors behind elastic transmissions respond to the impact.  The
denominator ``√(m C)`` is the response time of the joint springs.  Here ``m`` is the mass for the links alone, and ``C
= jK⁻¹jᵀ`` with the stiffness of the joint springs and ``j = nᵀJ``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import gamma, pi, sqrt

import numpy as np

from impact_posture.config.problem_settings import MATERIALS, JointModel
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.joint_model import transmissions, with_joint_model
from impact_posture.system.arrays import Array

# The integral ∫₀¹ dz/√(1 − z^{5/2}) is the ratio of T to δ/v for the force κδ^{3/2}.
HERTZ_TIME = sqrt(pi) * gamma(7 / 5) / gamma(9 / 10)
# Radius of the steel tip on the robot, m; a contact given by a material assumes this tip.
TIP_RADIUS = 0.01
# Recorded hits of a flat tool lasted 25 ms, which gives x = 1.7; the assumed tip gives x = 0.06 (docs/real-robot.md).
_TIP_ONLY = f"a flat or padded tool touches longer than the assumed steel tip of {1e3 * TIP_RADIUS:g} mm radius"
# A joint whose jump is below this fraction of the largest jump of a joint does not determine x.
_MOVED = 0.1
# If x ≤ ``SHORT``, only the links respond.  If x ≥ ``LONG``, the rotors respond too (docs/which-inertia.md).
SHORT, LONG = 0.2, 0.75
GIVE_ELASTICITY = "add `contact_stiffness` (N/m, or a material) or `contact_duration`"
"""Hint of the errors about an unknown elasticity of the contact."""


@dataclass(frozen=True)
class ContactStiffness:
    """The elasticity of a contact, given by exactly one of ``linear``, ``hertz`` and ``duration``.

    Attributes:
        linear: Stiffness k of a linear contact, N/m, or ``None``.
        hertz: Stiffness κ of a Hertzian contact, N/m^{3/2}, or ``None``.
        duration: Time T from touch to greatest compression, s, or ``None``.
        material: Name of the material from which κ was computed; empty for other contacts.
    """

    linear: float | None = None
    hertz: float | None = None
    duration: float | None = None
    material: str = ""

    @staticmethod
    def of(stiffness: float | str | None, duration: float | None) -> ContactStiffness | None:
        """Return the elasticity that the two settings describe; ``None`` if both settings are ``None``.

        ``stiffness`` is the setting ``contact_stiffness``, and ``duration`` the setting ``contact_duration``.

        Raises:
            InputError: Both settings are given.
        """
        if stiffness is not None and duration is not None:
            what = "cannot be combined with `contact_stiffness`"
            raise InputError(what, where="contact_duration", hint="give only one of the two settings")
        if duration is not None:
            return ContactStiffness(duration=duration)
        if isinstance(stiffness, str):
            return ContactStiffness(hertz=hertz_stiffness(stiffness), material=stiffness)
        return None if stiffness is None else ContactStiffness(linear=stiffness)

    def compression_time(self, mass: float, speed: float) -> float:
        """Return the compression time T, s, for the effective mass (kg) and the approach speed (m/s)."""
        if self.duration is not None:
            return self.duration
        if self.linear is not None:
            return pi / 2 * sqrt(mass / self.linear)
        return HERTZ_TIME * self._depth(mass, speed) / speed if speed > 0 else float("inf")

    def peak_force(self, mass: float, speed: float) -> float:
        """Return the normal force at greatest compression, N; arguments as in :meth:`compression_time`."""
        if self.duration is not None:
            return pi / 2 * mass * speed / self.duration
        if self.linear is not None:
            return speed * sqrt(self.linear * mass)
        return float((self.hertz or 0.0) * self._depth(mass, speed) ** 1.5)

    def _depth(self, mass: float, speed: float) -> float:
        """Return the greatest compression of a Hertzian contact, m."""
        return float((5 * mass * speed**2 / (4 * (self.hertz or 0.0))) ** 0.4)

    def linear_stiffness(self, mass: float, speed: float) -> float:
        """Return the stiffness k, N/m, of the linear contact that has the same compression time."""
        return self.linear or (pi / 2 / self.compression_time(mass, speed)) ** 2 * mass

    def largest_mass(self, force: float, speed: float) -> float:
        """Return the largest effective mass, kg, for which the peak force does not exceed ``force``, N."""
        # The peak force is proportional to mass^power.
        power = 1.0 if self.duration is not None else 0.5 if self.linear is not None else 0.6
        return float((force / self.peak_force(1.0, speed)) ** (1 / power))

    @property
    def words(self) -> str:
        """Description of the contact for users."""
        if self.duration is not None:
            return f"compressed within {1e3 * self.duration:.3g} ms"
        if self.linear is not None:
            return f"{self.linear:.3g} N/m"
        return f"steel tip of {1e3 * TIP_RADIUS:g} mm radius on {self.material}"

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        numbers = {"stiffness": self.linear, "hertz_stiffness": self.hertz, "duration": self.duration}
        return {**numbers, "material": self.material or None}


def milliseconds(time: float) -> str:
    """Return a time in s as text in ms with two digits, without an exponent."""
    return f"{float(f'{1e3 * time:.2g}'):g} ms"


def hertz_stiffness(material: str) -> float:
    """Return ``κ = (4/3) E* √R``, N/m^{3/2}, for a steel tip that touches a material (Johnson 1985, §4.2)."""
    inverse = sum((1 - nu**2) / E for E, nu in (MATERIALS["steel"], MATERIALS[material]))
    return 4 / 3 / inverse * sqrt(TIP_RADIUS)


@dataclass(frozen=True)
class Compression:
    """Compression of an elastic contact, and the ratio x that compares it with the joint springs.

    Attributes:
        contact: Elasticity of the contact; ``None`` if not known.
        mass: Effective mass m with friction, kg: normal impulse per approach speed.  The joint model of the objective
            determines whether rotors are included.
        time: Compression time T, s, of the mass ``mass``; ``None`` if not known.
        peak_force: Largest normal force F, N, of the mass ``mass``; ``None`` if not known.
        x: Ratio ``T/√(m C)``, with T and m of the links alone; ``None`` if the contact or the springs are unknown.
        by_material: Name of a material → x for a contact with this material; empty unless the springs are known and
            the contact is unknown.
        joint_model: The joint model of the objective.
        unknown_springs: Joints that the impact moves and whose springs are unknown, although other springs are known.
            Then x is unknown.
    """

    contact: ContactStiffness | None
    mass: float
    time: float | None
    peak_force: float | None
    x: float | None
    by_material: dict[str, float]
    joint_model: JointModel
    unknown_springs: tuple[str, ...] = ()

    @property
    def fitting(self) -> JointModel | None:
        """Joint model that is accurate for x: ``link`` for small x, ``reflected`` for large x.

        ``None`` if x is between :data:`SHORT` and :data:`LONG`, or if x is not known.
        """
        if self.x is None or SHORT < self.x < LONG:
            return None
        return "link" if self.x <= SHORT else "reflected"

    @property
    def line(self) -> str:
        """Explanation of x for users; empty if x is not known."""
        if self.unknown_springs:
            joints = ", ".join(self.unknown_springs)
            return f"x is unknown: the impact moves {joints}, whose stiffness robot.toml does not state"
        if self.x is None:
            if not self.by_material:
                return ""
            each = ", ".join(f"{float(f'{x:.2g}'):g} on {name}" for name, x in self.by_material.items())
            ranges = f"up to {SHORT:g}, only the links respond; from {LONG:g}, links and rotors respond"
            return f"x = {each} ({ranges}); {_TIP_ONLY}: state `contact_duration`"
        if self.fitting == "link":
            meaning = "the contact is over before the rotors move: joint model 'link'"
        elif self.fitting == "reflected":
            meaning = "the rotors move with the links: joint model 'reflected'"
        else:
            used = self.joint_model == "elastic"
            advice = "'elastic', which is used here, is" if used else "evaluate with `joint_model` elastic"
            meaning = f"neither 'link' nor 'reflected' is accurate; {advice}"
        tip = f"; {_TIP_ONLY}" if self.contact is not None and self.contact.material else ""
        return f"x = {self.x:.2g}: {meaning}{tip}"

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return {
            "contact": None if self.contact is None else self.contact.to_dict(),
            "mass": self.mass,
            "compression_time": self.time,
            "peak_force": self.peak_force,
            "x": self.x,
            "x_by_material": self.by_material,
            "unknown_springs": list(self.unknown_springs),
            "fitting_joint_model": self.fitting,
            "line": self.line,
        }


def compression(
    objective: WorstCaseObjective, q: Array, speed: float, contact: ContactStiffness | None
) -> Compression | None:
    """Return compression time, peak force and x of the impact, with friction, at the first contact.

    Return ``None`` if all three are unknown, or if the effective mass is unbounded (:func:`contact_mass`).  ``q`` has
    shape (nq,), and ``speed`` is the approach speed, m/s.  If ``contact`` is ``None``, x is computed for every
    material in :data:`MATERIALS`.
    """
    springs, mass = springs_along(objective.case, q), contact_mass(objective.oracle, q)
    if (contact is None and springs is None) or mass is None:
        return None
    unknown = unknown_springs(objective.case, q) if springs is not None else ()
    time = force = x = None
    by_material: dict[str, float] = {}
    if contact is not None:
        numbers = contact.compression_time(mass, speed), contact.peak_force(mass, speed)
        time, force = (value if np.isfinite(value) else None for value in numbers)
    if springs is not None and not unknown:
        links, C = springs
        if contact is not None:
            x = contact.compression_time(links, speed) / sqrt(links * C)
        elif speed > 0:
            each = {name: ContactStiffness(hertz=hertz_stiffness(name)) for name in MATERIALS}
            by_material = {name: tip.compression_time(links, speed) / sqrt(links * C) for name, tip in each.items()}
    if x is not None and not np.isfinite(x):
        x = None
    return Compression(contact, mass, time, force, x, by_material, objective.robot.joint_model, unknown)


def contact_mass(oracle: ImpactOracle, q: Array) -> float | None:
    """Return the effective mass with friction at ``q``, kg: normal impulse per approach speed.

    Return ``None`` if the mass is unbounded: the contact point cannot move along the normal, or can only move with a
    slip that the friction prevents.
    """
    if oracle.quantities(q).blocked:
        return None
    try:
        return coulomb_impact(oracle, q).mass
    except MetricError:
        return None


def springs_along(case: ImpactCase, q: Array) -> tuple[float, float] | None:
    """Return the effective mass of the links alone, kg, and the compliance ``C = jK⁻¹jᵀ`` of the joint springs, m/N.

    Return ``None`` if the mass is unbounded, or if a force at the contact deflects no spring of known stiffness.
    """
    try:
        compliance = ElasticImpact(case).compliance(q)
    except InputError:
        return None
    mass = contact_mass(ImpactOracle(replace(case, robot=with_joint_model(case.robot, "link"))), q)
    return None if mass is None or compliance <= 0 else (mass, compliance)


def unknown_springs(case: ImpactCase, q: Array) -> tuple[str, ...]:
    """Return the joints that the impact moves and that have a rotor behind a spring of unknown stiffness.

    The impact moves a joint if the velocity jump of the joint, without rotors, is at least the fraction
    :data:`_MOVED` of the largest jump of any joint.
    """
    robot, table = case.robot, transmissions(case.robot)
    joints = np.arange(robot.nv) >= robot.first_joint
    jump = ImpactOracle(replace(case, robot=with_joint_model(robot, "link"))).quantities(q).jump
    sizes = np.where(joints, np.abs(jump), 0.0)
    springless = joints & ~table.rigid & ~table.locked & ~table.elastic & (robot.armature > 0)
    moved = np.flatnonzero(springless & (sizes >= _MOVED * sizes.max(initial=0.0)) & (sizes > 0))
    return tuple(robot.tangent_names[k] for k in moved[np.argsort(-sizes[moved])])


def both_models(objective: WorstCaseObjective) -> dict[JointModel, WorstCaseObjective]:
    """Return the objective with the joint model ``link`` and with the joint model ``reflected``."""
    names: tuple[JointModel, ...] = ("link", "reflected")
    return {name: replace(objective, robot=with_joint_model(objective.robot, name)) for name in names}
