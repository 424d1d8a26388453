"""When the impact-robust term is on: free, brace, contact, release."""

from __future__ import annotations

from enum import Enum

from impact_posture.errors import InputError
from impact_posture.tsid.posture_tasks import smooth


class Phase(Enum):
    """Where in the course of an anticipated impact the controller is."""

    FREE = "free"
    BRACE = "brace"
    CONTACT = "contact"
    RELEASE = "release"


# Which phase may follow which; the end of a release leads back to FREE by itself.
_FOLLOWS = {
    Phase.FREE: (Phase.BRACE,),
    Phase.BRACE: (Phase.CONTACT, Phase.RELEASE),
    Phase.CONTACT: (Phase.RELEASE,),
    Phase.RELEASE: (Phase.BRACE,),
}


class Activation:
    """A level between 0 and 1 that moves along ``3x² − 2x³`` towards what the phase asks for.

    FREE: 0.  BRACE: 1.  CONTACT: 1, or 0 if the robot holds the reached posture during the impact.  RELEASE: 0, then
    FREE.

    Within ``dt`` the level moves by at most ``1.5 dt/ramp`` (:meth:`step_bound`), whatever is asked when.

    Attributes:
        phase: The present one.
        ramp: Seconds from 0 to 1 and back.
        live: Whether the term stays on during the contact.
        level: The present level α.
    """

    def __init__(self, *, ramp: float = 0.3, live: bool = False) -> None:
        """Start free.

        Raises:
            InputError: A ramp that is not positive.
        """
        if not ramp > 0:
            raise InputError("the ramp is not positive", where="activation", hint="give seconds above zero")
        self.ramp, self.live = ramp, live
        self.phase, self.level, self._x, self._goal = Phase.FREE, 0.0, 0.0, 0.0

    def reset(self) -> None:
        """Free, level zero."""
        self.phase, self.level, self._x, self._goal = Phase.FREE, 0.0, 0.0, 0.0

    def enter(self, phase: Phase) -> None:
        """Go to the next phase.

        Raises:
            InputError: It does not follow the present one.
        """
        if phase not in _FOLLOWS[self.phase]:
            names = " or ".join(p.value for p in _FOLLOWS[self.phase])
            raise InputError(
                f"'{phase.value}' does not follow '{self.phase.value}'", where="activation", hint=f"ask for {names}"
            )
        self.phase = phase
        on = phase is Phase.BRACE or (phase is Phase.CONTACT and self.live)
        self._goal = 1.0 if on else 0.0

    @property
    def goal(self) -> float:
        """The level that the phase asks for."""
        return self._goal

    def advance(self, dt: float) -> float:
        """Let ``dt`` seconds pass; return the level."""
        goal = self._goal
        if self._x != goal:
            step = dt / self.ramp
            self._x = min(goal, self._x + step) if goal > self._x else max(goal, self._x - step)
            self.level = smooth(self._x)
        if self.phase is Phase.RELEASE and self._x == 0.0:
            self.phase = Phase.FREE
        return self.level

    def step_bound(self, dt: float) -> float:
        """The most that the level moves within ``dt`` seconds."""
        return min(1.0, 1.5 * dt / self.ramp)
