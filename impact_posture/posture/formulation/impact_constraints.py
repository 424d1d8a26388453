"""Constraints that bound an impact, or what it does to the feet, in every model variant."""

from __future__ import annotations

from collections.abc import Sequence

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.impact_bounds import ImpactBounds
from impact_posture.posture.constraints.kept_contacts import KeptContacts


def limits(objective: WorstCaseObjective, bounds: tuple[float, float], variant: str = "") -> list[Constraint]:
    """Return the bounds on an impact, by contact; none where nothing is bounded or all joints are locked."""
    made = [ImpactBounds(single, *bounds, variant) for single in objective.singles]
    return [constraint for constraint in made if constraint.rows]


def kept_feet(objective: WorstCaseObjective, numeric: Numeric, friction: float) -> list[Constraint]:
    """Return what keeps the feet, by contact.  Cones are convex, so feet that stay under each impact do under all."""
    if objective.bilateral:
        raise InputError(
            "contacts that pull as well as push would have to leave the feet without any impulse",
            where="keep_contacts",
            hint="leave out `bilateral` or `keep_contacts`",
        )
    return [KeptContacts(single, numeric, friction) for single in objective.singles]


def in_every_variant(
    objective: WorstCaseObjective,
    numeric: Numeric,
    friction: float,
    bounds: tuple[float, float],
    constraints: Sequence[Constraint],
) -> list[Constraint]:
    """Return the constraints of the other model variants that those of the robot as modeled do not imply.

    A pose does not depend on the weight of the robot, but its center of mass and the support impulses do.  Without
    these constraints a posture could tip over with the very payload that it was found for.
    """
    found: list[Constraint] = []
    kept = any(isinstance(constraint, KeptContacts) for constraint in constraints)
    centers = [constraint for constraint in constraints if isinstance(constraint, CenterOfMassOverFeet)]
    for variant, member in zip(objective.model_variants[1:], objective.by_variant[1:], strict=True):
        # The armature does not move the center of mass.
        if variant.payload is not None and variant.armature_factor == 1:
            loaded = variant.robot.model, variant.name
            found += [CenterOfMassOverFeet(c.normals, c.offsets, c.margin, loaded) for c in centers]
        if kept:
            found += [KeptContacts(single, numeric, friction, variant.name) for single in member.singles]
        found += limits(member, bounds, variant.name)
    return found
