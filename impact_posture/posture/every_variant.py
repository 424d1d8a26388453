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
    """The constraints of the other scenarios that a problem's own do not imply; none without scenarios.

    Args:
        objective: With its scenarios, the robot as modeled first.
        numeric: At the given posture.
        friction: Of the feet that stay.
        constraints: Of the robot as modeled.
    """
    found: list[Constraint] = []
    kept = any(isinstance(constraint, KeptFeet) for constraint in constraints)
    centers = [constraint for constraint in constraints if isinstance(constraint, CenterOfMassOverFeet)]
    for scenario, member in zip(objective.scenarios[1:], objective.by_scenario[1:], strict=True):
        # The armature moves no center of mass.
        if scenario.payload is not None and scenario.armature_factor == 1:
            loaded = scenario.robot.model, scenario.name
            found += [CenterOfMassOverFeet(c.normals, c.offsets, c.margin, loaded) for c in centers]
        if kept:
            found += [KeptFeet(single, numeric, friction, scenario.name) for single in member.singles]
    return found
