"""A robot that falls onto its contacts, which are then its feet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impact_posture.impact.objective import Objective
from impact_posture.impact.supports import resolve_supports
from impact_posture.robot.robot_spec import Support


def falls_freely(objective: Objective, base: str) -> bool:
    """Return whether a robot falls before the impact, because it has neither rotors, nor feet, nor a fixed base.

    ``base`` says how the base may move (:class:`~impact_posture.posture.constraints.requirements.Requirements`).
    """
    robot = objective.robot
    held = robot.spec.propulsion is not None or objective.supports or base == "fixed"
    return bool(robot.floating and np.any(robot.model.gravity.linear) and not held)


def landing_feet(objective: Objective) -> tuple[Support, ...]:
    """Return a foot for each contact: the known sole of its frame, or else the contact point."""
    known, feet = {s.frame: s for s in resolve_supports(objective.robot, None)}, []
    for contact in objective.contacts:
        foot = known.get(contact.frame, Support(contact.frame))
        feet.append(foot if foot.has_sole else replace(foot, offset=contact.offset))
    return tuple(feet)
