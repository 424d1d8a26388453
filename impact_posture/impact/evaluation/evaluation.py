"""All quantities of one impact at one posture, which the command ``evaluate`` and ``result.json`` show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated

import numpy as np
import pinocchio as pin

from impact_posture.config.checked import checked
from impact_posture.config.demand import Share, between
from impact_posture.config.json_block import JsonBlock
from impact_posture.config.problem_settings import RESTITUTION, SPEED
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.elasticity.contact_compression import (
    GIVE_ELASTICITY,
    Compression,
    ContactStiffness,
    both_models,
    compression,
    contact_mass,
)
from impact_posture.impact.elasticity.elastic_impact import ElasticImpact, ElasticResponse
from impact_posture.impact.evaluation.coulomb_jump import CoulombJump, coulomb_jump, coulomb_jumps
from impact_posture.impact.evaluation.dominance import Dominance, find_dominance
from impact_posture.impact.evaluation.ellipsoids import Ellipsoid, ellipsoid_of
from impact_posture.impact.evaluation.joint_yield import JointYield, joint_yield
from impact_posture.impact.evaluation.objective_value import (
    VariantValue,
    objective_gradient,
    objective_value,
    variant_values,
    worst_variant,
)
from impact_posture.impact.evaluation.standing_impact import StandingImpact, standing_impact
from impact_posture.impact.evaluation.velocity_jump import Jump, frictionless_jump, normal_jump, sticking_jump
from impact_posture.impact.friction.contact_stability import ContactStability, contact_stability
from impact_posture.impact.impact_contact import LARGEST, point_on
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.impact_quantities import Scalars
from impact_posture.impact.worst_case.impulse_box import ImpulseBox, WorstImpulses
from impact_posture.impact.worst_case.worst_normal import WorstNormal
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array

# If supports that are ten times as stiff change H by more than this fraction, a warning is shown.
_SOFT = 0.01


@dataclass(frozen=True, eq=False)
class Evaluation(JsonBlock):
    """All quantities of one impact at one posture.

    Attributes:
        q: Configuration, shape (nq,).
        scalars: H, G, V, S and E, computed with the supports; also attributes of the evaluation.
        objective: Value of the objective; for ``impulse`` with the factor λ̄², where λ̄ is the largest impulse of the
            contact.  ``None`` if the objective does not exist at ``q``.
        gradient: Tangent gradient of H, shape (nv,).  The entry of a leader joint includes the motion of its
            followers.  The entries of followers are zero.
        objective_gradient: Tangent gradient of the objective, shape (nv,); ``None`` if it does not exist at ``q``.
        normal: Unit normal for which H, G, V, S, E and the jumps are computed, world axes, shape (3,).
        worst_normal: Unit normal for which the objective is computed, world axes, shape (3,).  With a cone of
            normals, the worst normal of the cone; otherwise equal to ``normal``.
        cone: Worst case over the cone of normals, world axes; ``None`` if there is no cone or no objective value.
        ellipsoid: Dynamic impact ellipsoid ``Λ_c``.
        pose: World placement of the contact frame.
        speed: Approach speed of the predicted impact, m/s.
        restitution: Coefficient of restitution of the predicted impact.
        frictionless: Jump without friction; ``None`` if the contact cannot move along the normal.
        sticking: Jump if the contact point sticks; ``None`` if S does not exist at ``q``.
        coulomb: Jump with the friction of the contact, which sticks or slides; ``None`` if there is no such jump.
        together: Jump of a plastic impact, with friction, at all contacts at once; one entry per contact.  ``None``
            for one contact, for contacts that can pull, or if the iteration does not converge.
        energy_loss: Energy that the frictionless impact dissipates, J; ``None`` if the contact cannot move along the
            normal.
        contact_mass: Effective mass with friction, kg: normal impulse per approach speed; ``None`` if it is
            unbounded.
        compression: Compression time, peak force and the ratio x; ``None`` if all of them are unknown.
        elastic: Response of links, rotors and springs to the contact; ``None`` unless the joint model is ``elastic``.
        joint_yield: How the joints move the contact along the normal; ``None`` if no joint moves it.
        dominance: Share of the joint that contributes most to H.
        without_supports: H, G, V, S, E of the robot without its supports; ``None`` for a robot without supports.
        compliance_effect: Relative change of H if the supports have a tenth of the compliance; ``None`` for a robot
            without supports.
        contact_stability: Whether the feet stay on the ground in the impact; ``None`` for a robot without supports.
        standing: The impact if the ground can only push the feet; ``None`` for a robot without supports, or if this
            impact cannot be computed.
        contacts: Separate evaluation of each contact, in the order of the objective; empty if there is only one
            contact.
        impulses: Worst impulses of several contacts; ``None`` if there is only one contact.
        model_variants: Objective and scalars for each model variant; empty if there are no variants.
        warnings: Limits of the validity of these quantities, one line each.
    """

    q: Array
    scalars: Scalars
    objective: float | None
    gradient: Array
    objective_gradient: Array | None
    normal: Array
    worst_normal: Array
    cone: WorstNormal | None
    ellipsoid: Ellipsoid
    pose: pin.SE3
    speed: float
    restitution: float
    frictionless: Jump | None
    sticking: Jump | None
    coulomb: CoulombJump | None
    together: tuple[CoulombJump, ...] | None
    energy_loss: float | None
    contact_mass: float | None
    compression: Compression | None
    elastic: ElasticResponse | None
    joint_yield: JointYield | None
    dominance: Dominance
    without_supports: Scalars | None
    compliance_effect: float | None
    contact_stability: ContactStability | None
    standing: StandingImpact | None
    contacts: tuple[Evaluation, ...]
    impulses: WorstImpulses | None
    model_variants: tuple[VariantValue, ...]
    warnings: tuple[str, ...]

    H = property(attrgetter("scalars.H"), doc="Squared jump per squared impulse.")
    G = property(attrgetter("scalars.G"), doc="Inverse effective mass along the normal, 1/kg.")
    V = property(attrgetter("scalars.V"), doc="Squared jump per squared approach speed, frictionless, or ``None``.")
    S = property(attrgetter("scalars.S"), doc="Squared jump per squared approach speed if sticking, or ``None``.")
    E = property(attrgetter("scalars.E"), doc="Energy lost per squared approach speed, kg, or ``None``.")

    def to_dict(self) -> dict[str, object]:
        """Return the ``initial`` or ``optimal`` block of ``result.json``; undefined values are ``None``."""
        content, quaternion = super().to_dict(), pin.Quaternion(self.pose.rotation)
        block: dict[str, object] = {
            **{key: content[key] for key in ("q", "objective")},
            **content["scalars"],
            "effective_mass": self.scalars.effective_mass,
            "effective_mass_with_friction": self.contact_mass,
            **{key: content[key] for key in ("gradient", "objective_gradient", "worst_normal", "ellipsoid")},
            "pose": {"position": self.pose.translation.tolist(), "quaternion_xyzw": quaternion.coeffs().tolist()},
            "jump": {key: content[key] for key in _JUMP},
            **{key: content[key] for key in ("compression", "elastic", "joint_yield", "dominance")},
        }
        if self.cone is not None:
            block["cone"] = content["cone"]
        if self.without_supports is not None:
            block |= {"free": content["without_supports"], "compliance_effect": self.compliance_effect}
        if self.contact_stability is not None:
            block |= {"footing": content["contact_stability"], "lifting_feet": content["standing"]}
        if self.impulses is not None:
            block["worst_impulses"] = content["impulses"]
        if self.contacts:
            block["coulomb_together"] = content["together"]
            block["by_contact"] = [
                {key: part[key] for key in _CONTACT if key in part} for part in content["contacts"]
            ]
        if self.model_variants:
            block["by_scenario"] = content["model_variants"]
            block["worst_scenario"] = self.model_variants[worst_variant(self.model_variants)].name
        return block


_JUMP = ("speed", "restitution", "frictionless", "sticking", "coulomb", "energy_loss")
# Keys of the block of each single contact.  Posture and objective are the same for all contacts, so the block of a
# single contact omits them.
_CONTACT = (
    "H",
    "G",
    "V",
    "S",
    "E",
    "effective_mass",
    "gradient",
    "ellipsoid",
    "pose",
    "free",
    "footing",
    "lifting_feet",
)


@checked
def evaluate(
    objective: WorstCaseObjective,
    q: Array,
    speed: Annotated[float, between(0, LARGEST, "m/s")] = SPEED,
    restitution: Share = RESTITUTION,
    contact_stiffness: ContactStiffness | None = None,
) -> Evaluation:
    """Compute all impact quantities at ``q`` with Pinocchio, and predict the velocity jump.

    ``q`` has shape (nq,), ``speed`` is the approach speed ``v_n``, m/s, and ``restitution`` the coefficient ``e``.

    Raises:
        InputError: The speed is negative or not finite, or the restitution lies outside [0, 1].
    """
    robot, oracle = objective.robot, objective.oracle
    quantities = oracle.quantities(q)
    scalars = Scalars.of(quantities)
    rebound = normal_jump(speed, restitution)
    without_supports, effect = _without_supports(objective, q, quantities.H)
    model_variants = variant_values(objective, q)
    member = objective.by_variant[worst_variant(model_variants)] if model_variants else objective
    value = objective_value(member, q)
    C, slope = objective.robot.coupling_matrix, objective_gradient(member, q, value)
    cone = _worst(member, q)
    singles = objective.singles if objective.others else ()
    squeezed = compression(objective, q, speed, contact_stiffness)
    return Evaluation(
        q=np.array(q, dtype=float),
        scalars=scalars,
        objective=value,
        gradient=C.T @ oracle.gradient_H(q),
        objective_gradient=None if slope is None else C.T @ slope,
        normal=quantities.normal,
        worst_normal=quantities.normal if cone is None else cone.normal,
        cone=cone,
        ellipsoid=ellipsoid_of(quantities.ellipsoid),
        pose=oracle.at(q).numeric.placement(point_on(robot, objective.contact.frame)),
        speed=speed,
        restitution=restitution,
        frictionless=frictionless_jump(objective, quantities, rebound),
        sticking=sticking_jump(objective, quantities, rebound),
        coulomb=None if scalars.E is None else coulomb_jump(objective, q, rebound),
        together=coulomb_jumps(objective, q, speed) if objective.others else None,
        energy_loss=None if scalars.E is None else scalars.E * speed**2 * (1 - restitution**2),
        contact_mass=contact_mass(oracle, q),
        compression=squeezed,
        elastic=_elastic(objective, q, speed, contact_stiffness),
        joint_yield=joint_yield(objective, q),
        dominance=find_dominance(objective, quantities),
        without_supports=without_supports,
        compliance_effect=effect,
        contact_stability=contact_stability(oracle, objective.supports, q) if objective.supports else None,
        standing=standing_impact(objective, q, rebound, None if squeezed is None else squeezed.time),
        contacts=tuple(evaluate(single, q, speed, restitution, contact_stiffness) for single in singles),
        impulses=member.worst_case.worst(q) if isinstance(member.worst_case, ImpulseBox) else None,
        model_variants=model_variants,
        warnings=(*_warnings(scalars, effect), *_joint_model_warning(objective, q, squeezed)),
    )  # fmt: skip


def _worst(objective: WorstCaseObjective, q: Array) -> WorstNormal | None:
    if objective.normal_cone is None:
        return None
    try:
        return objective.normal_cone.worst_in_world(q)
    except MetricError:
        return None


def _without_supports(objective: WorstCaseObjective, q: Array, H: float) -> tuple[Scalars | None, float | None]:
    if not objective.supports:
        return None, None
    case = objective.case
    alone = Scalars.of(ImpactOracle(replace(case, supports=())).quantities(q))
    stiffer = ImpactOracle(replace(case, compliance=case.compliance / 10)).quantities(q).H
    return alone, abs(stiffer - H) / H if H > 0 else 0.0


def _elastic(
    objective: WorstCaseObjective, q: Array, speed: float, contact: ContactStiffness | None
) -> ElasticResponse | None:
    if objective.robot.joint_model != "elastic":
        return None
    if contact is None:
        what = "elastic needs the elasticity of the contact"
        raise InputError(what, where="joint_model", hint=GIVE_ELASTICITY)
    # The elastic response has no friction, so the contact is matched to the effective mass without friction.
    stiffness = contact.linear_stiffness(1 / objective.oracle.quantities(q).G, speed)
    return ElasticImpact(objective.case).response(q, stiffness, speed)


def _joint_model_warning(objective: WorstCaseObjective, q: Array, squeezed: Compression | None) -> tuple[str, ...]:
    """If the joint model is not accurate for x, return a warning with the objective of both rigid joint models."""
    if squeezed is None or (squeezed.x is None and not squeezed.unknown_springs):
        return ()
    if objective.robot.joint_model in (squeezed.fitting, "locked", "elastic"):
        return ()
    values = {name: objective_value(other, q) for name, other in both_models(objective).items()}
    listed = ", ".join(f"{value:.4g} with '{name}'" for name, value in values.items() if value is not None)
    advice = f"use `joint_model` {squeezed.fitting}" if squeezed.fitting else "expect a value between the two"
    return (f"{squeezed.line}; the objective is {listed}: {advice}",)


def _warnings(scalars: Scalars, effect: float | None) -> tuple[str, ...]:
    lines = []
    if scalars.E is None:
        lines.append(
            "the contact point cannot move along the normal in this posture, so its effective mass is unbounded, "
            "and V and E are undefined: choose another posture"
        )
    if scalars.S is None:
        lines.append(
            "S is undefined: the normal has a component along which the contact point cannot move in this posture"
        )
    if effect is not None and effect > _SOFT:
        lines.append(
            f"H changes by {100 * effect:.2g} % if the compliance of the supports is divided by ten: along this "
            "normal, the result depends on the assumed compliance"
        )
    return tuple(lines)
