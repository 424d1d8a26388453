"""The predicted impact of a standing robot whose feet can lift and slide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.elasticity.contact_compression import milliseconds
from impact_posture.impact.evaluation.velocity_jump import Jump, weighed_jump
from impact_posture.impact.friction.unilateral_impact import StandingFeet, longest_lifting_time, unilateral_impact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array

# The search for the contact time at which the weight keeps the feet in place ends at this time, s.  No impact lasts
# longer.
_LONGEST = 0.1


@dataclass(frozen=True, eq=False)
class StandingImpact(JsonBlock):
    """The predicted impact if the ground can only push the feet.

    Attributes:
        lifts: Frames of the feet that lift or tip.
        slides: Frames of the feet that slide without lifting.
        time: Time over which the feet carry the weight in this prediction, s: the compression time of the contact, or
            zero if this time or the weight on the feet is unknown.
        holding_time: Shortest contact time at which the weight keeps all feet in place, s.  ``None`` if the user gave
            the contact time, if no foot moves, or if the shortest time is above 0.1 s.
    """

    jump: Jump
    lifts: tuple[str, ...]
    slides: tuple[str, ...]
    time: float
    holding_time: float | None
    derived = ("line",)

    @property
    def moves(self) -> bool:
        """Whether a foot lifts or slides."""
        return bool(self.lifts or self.slides)

    @property
    def line(self) -> str:
        """Description of the effect of the impact on the feet."""
        counted = f" with the weight over the {milliseconds(self.time)} of the contact" if self.time > 0 else ""
        moved = (("lifts or tips", self.lifts), ("slides", self.slides))
        does = [f"{verb} {', '.join(frames)}" for verb, frames in moved if frames]
        if not does:
            return f"the feet stay{counted}"
        shorter = (
            "" if self.holding_time is None else f" if the contact is shorter than {milliseconds(self.holding_time)}"
        )
        return f"the impact {' and '.join(does)}{counted}{shorter}"


def standing_impact(
    objective: WorstCaseObjective, q: Array, rebound: float, time: float | None
) -> StandingImpact | None:
    """Predict the impact at ``q``, shape (nq,), with feet that can lift and slide.

    ``rebound`` is ``(1+e) v_n``, m/s, and ``time`` the compression time of the contact, s; ``None`` if it is unknown.
    The friction coefficient of the contact is also the coefficient of the feet.  Return ``None`` if the robot has no
    supports or does not move, or if no impulses fulfill the conditions of the contacts.
    """
    if not objective.supports or rebound <= 0:
        return None
    singles = objective.singles if objective.others else (objective,)
    hit = [single.oracle.at(q) for single in singles]
    feet = StandingFeet(objective.oracle, objective.supports, q, objective.contact.friction)
    counted = 0.0 if time is None or feet.forces is None else time
    impact = unilateral_impact(feet, hit, rebound, counted)
    if impact is None:
        return None
    holding = np.inf
    if (impact.lifts or impact.slides) and time is None:
        holding = longest_lifting_time(feet, hit, rebound, _LONGEST)
    objective.oracle.at(q)
    return StandingImpact(
        weighed_jump(objective, impact.jump, impact.impulses[0]),
        impact.lifts,
        impact.slides,
        counted,
        float(holding) if np.isfinite(holding) else None,
    )
