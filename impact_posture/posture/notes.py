"""What the numbers of an answer alone would not tell a user."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from impact_posture.impact.objective import ImpactObjective, Objective

Vector = NDArray[np.float64]

# The share of the initial 1/mass below which a contact counts as locked.
_LOCKED = 0.05


def percent(share: float) -> str:
    """Return a share in percent: digits enough never to read 100 where it is less, and no minus before a zero."""
    for digits in range(1, 15):
        text = f"{100 * share:.{digits}f}"
        if abs(share) >= 1 or abs(float(text)) != 100:
            break
    return f"{text.removeprefix('-') if float(text) == 0 else text}%"


def notes_on_impacts(objective: Objective, initial: Vector, q: Vector) -> list[str]:
    """Where a smaller jump per impulse is no smaller jump per speed, and contacts that lock; one line each."""
    notes: list[str] = []
    if not isinstance(objective, ImpactObjective):
        return notes
    for single in objective.singles:
        start, end = single.oracle.quantities(initial), single.oracle.quantities(q)
        before, after = start.G, end.G
        where = f" at {single.contact.frame}" if objective.others else ""
        if after < _LOCKED * before:
            notes.append(
                f"the contact{where} is nearly locked along the normal there: its effective mass is "
                f"{before / max(after, 1e-300):.3g} times that of the start, and so is the impulse at a given "
                "approach speed; compare V and S, or minimize them (`objective='speed'`, sticking)"
            )
        elif objective.kind == "impulse" and not objective.others and end.V > start.V * (1 + 1e-3):
            notes.append(
                f"at a given approach speed without friction the jump grows: V {start.V:.4g} to {end.V:.4g}; "
                "`objective='speed'` minimizes that"
            )
    return notes
