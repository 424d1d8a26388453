"""Notes on the impact at an optimal posture, and shares in percent."""

from __future__ import annotations

from impact_posture.impact.objective import Objective
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.arrays import Array

# A contact is reported as locked if its inverse effective mass falls below this fraction of the initial value.
_LOCKED = 0.05


def percent(share: float) -> str:
    """Format a share in percent, with enough digits that only exactly 100 % is printed as 100 %."""
    for digits in range(1, 15):
        text = f"{100 * share:.{digits}f}"
        if abs(share) >= 1 or abs(float(text)) != 100:
            break
    return f"{text.removeprefix('-') if float(text) == 0 else text}%"


def notes_on_impacts(objective: Objective, initial: Array, q: Array) -> list[str]:
    """Return notes on contacts that the optimal posture nearly locks along the normal."""
    notes: list[str] = []
    if not isinstance(objective, WorstCaseObjective):
        return notes
    for single in objective.singles:
        before, after = (single.oracle.quantities(posture).G for posture in (initial, q))
        where = f" at {single.contact.frame}" if objective.others else ""
        if after < _LOCKED * before:
            notes.append(
                f"the contact{where} is nearly locked along the normal there: its effective mass is "
                f"{before / max(after, 1e-300):.3g} times its initial value, as is the impulse for a given "
                "approach speed; compare V and S, or minimize them (`objective` auto)"
            )
    return notes
