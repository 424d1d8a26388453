"""Phases of an anticipated impact, and the activation level of the impact-robust term in each phase."""

from __future__ import annotations

from enum import Enum

from impact_posture.config.checked import checked
from impact_posture.config.demand import Positive
from impact_posture.errors import InputError
from impact_posture.tsid.smooth_step import smooth

# Default time in which the level changes from 0 to 1, s.
RAMP = 0.3


class Phase(Enum):
    """Phase of the controller around an anticipated impact."""

    FREE = "free"
    BRACE = "brace"
    CONTACT = "contact"
    RELEASE = "release"


# Phase → phases that a call of ``enter`` may start next.  RELEASE changes to FREE without a call of ``enter``.
_FOLLOWS = {
    Phase.FREE: (Phase.BRACE,),
    Phase.BRACE: (Phase.CONTACT, Phase.RELEASE),
    Phase.CONTACT: (Phase.RELEASE,),
    Phase.RELEASE: (Phase.BRACE,),
}


@checked
class Activation:
    """Activation level between 0 and 1 that changes smoothly, along ``3x² − 2x³``, to the goal of the phase.

    The goal is 0 in FREE, 1 in BRACE, and 0 in RELEASE.  RELEASE changes to FREE when the level is 0.  In CONTACT,
    the goal is 1 if ``live`` is true.  Otherwise, the goal is 0, and the robot keeps the reached posture during the
    impact.  Within ``dt`` seconds, the level changes by at most ``1.5 dt/ramp``.

    Attributes:
        ramp: Time in which the level changes from 0 to 1, or from 1 to 0, s.
        live: Whether the impact-robust term stays on during the contact.
        level: The present level α.
        goal: Final level in the present phase.
    """

    def __init__(self, *, ramp: Positive = RAMP, live: bool = False) -> None:
        self.ramp, self.live = ramp, live
        self.reset()

    def reset(self) -> None:
        """Set the phase to FREE and the level to zero."""
        self.phase, self.level, self.goal, self._x = Phase.FREE, 0.0, 0.0, 0.0

    def enter(self, phase: Phase) -> None:
        """Go to the next phase.

        Raises:
            InputError: ``phase`` may not follow the present phase.
        """
        if phase not in _FOLLOWS[self.phase]:
            names = " or ".join(p.value for p in _FOLLOWS[self.phase])
            what = f"'{phase.value}' does not follow '{self.phase.value}'"
            raise InputError(what, where="activation", hint=f"enter {names}")
        self.phase = phase
        on = phase is Phase.BRACE or (phase is Phase.CONTACT and self.live)
        self.goal = 1.0 if on else 0.0

    def advance(self, dt: float) -> float:
        """Advance the level by ``dt`` seconds and return it."""
        if self._x != self.goal:
            step = dt / self.ramp
            self._x = min(self.goal, self._x + step) if self.goal > self._x else max(self.goal, self._x - step)
            self.level = smooth(self._x)
        if self.phase is Phase.RELEASE and self._x == 0.0:
            self.phase = Phase.FREE
        return self.level
