"""What a task asks of the robot as modeled, asked of what it may turn out to be as well.

A pose is the same whatever the robot weighs.  Its center of mass and the feet's impulses are not.  Without these
constraints a posture could tip over with the very payload that it was found for.
"""

from __future__ import annotations

from collections.abc import Sequence

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.objective import ImpactObjective
from impact_posture.posture.constraint import CenterOfMassOverFeet, Constraint
from impact_posture.posture.kept_feet import KeptFeet


def in_every_variant(
    objective: ImpactObjective, numeric: Numeric, friction: float, constraints: Sequence[Constraint]
) -> list[Constraint]:
    """The constraints of the other model_variants that a problem's own do not imply; none without model_variants.

    Args:
        objective: With its model_variants, the robot as modeled first.
        numeric: At the given posture.
        friction: Of the feet that stay.
        constraints: Of the robot as modeled.
    """
    found: list[Constraint] = []
    kept = any(isinstance(constraint, KeptFeet) for constraint in constraints)
    centers = [constraint for constraint in constraints if isinstance(constraint, CenterOfMassOverFeet)]
    for variant, member in zip(objective.model_variants[1:], objective.by_variant[1:], strict=True):
        # The armature moves no center of mass.
        if variant.payload is not None and variant.armature_factor == 1:
            loaded = variant.robot.model, variant.name
            found += [CenterOfMassOverFeet(c.normals, c.offsets, c.margin, loaded) for c in centers]
        if kept:
            found += [KeptFeet(single, numeric, friction, variant.name) for single in member.singles]
    return found
