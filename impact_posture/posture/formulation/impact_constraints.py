"""The constraints on the impact and on the feet during the impact, for each contact and model variant."""

from __future__ import annotations

from collections.abc import Sequence

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.constraint import Constraint
from impact_posture.posture.constraints.impact_bounds import ImpactBounds
from impact_posture.posture.constraints.kept_contacts import KeptContacts
from impact_posture.posture.constraints.requirements import Requirements


def impact_constraints(
    objective: WorstCaseObjective, numeric: Numeric, requirements: Requirements, constraints: Sequence[Constraint]
) -> list[Constraint]:
    """Return the bounds on the impact and the constraints on the feet for all model variants.

    It suffices that the feet stay in place for an impact at each single contact.  The feet then also stay for impacts
    at all contacts at once, because friction cones are convex.  A payload moves the center of mass.  The constraint
    on the center of mass, if ``constraints`` contains it, is therefore repeated for each model with a payload.

    Raises:
        InputError: The feet must stay in place, but the contacts can also pull.
    """
    if requirements.keep_contacts and objective.bilateral:
        fault = "with contacts that pull as well as push, the feet stay only if no impulse acts on them"
        raise InputError(fault, where="keep_contacts", hint="leave out `bilateral` or `keep_contacts`")
    added: list[Constraint] = []
    centers = [constraint for constraint in constraints if isinstance(constraint, CenterOfMassOverFeet)]
    for k, member in enumerate((objective, *objective.by_variant[1:])):
        variant = objective.model_variants[k] if k else None
        name = variant.name if variant else ""
        # Variants that change the armature are skipped, because the armature does not move the center of mass.
        if variant and variant.payload is not None and variant.armature_factor == 1:
            loaded = variant.robot.model, name
            added += [CenterOfMassOverFeet(c.normals, c.offsets, c.margin, loaded) for c in centers]
        if requirements.keep_contacts:
            added += [KeptContacts(single, numeric, requirements.friction, name) for single in member.singles]
        limits = requirements.largest_mass, requirements.largest_jump
        bounds = [ImpactBounds(single, *limits, name) for single in member.singles]
        # ``ImpactBounds`` has no rows if the settings limit nothing, or if all joints are locked.
        added += [bound for bound in bounds if bound.rows]
    return added
