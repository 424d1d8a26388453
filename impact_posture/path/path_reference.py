"""References along a path for a controller: to the end, or through a strike and the stop after the contact."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import pinocchio as pin

from impact_posture.path.posture_path import PosturePath
from impact_posture.path.row_interpolation import Moment, RowInterpolation
from impact_posture.posture.approach.attainable_speed import RUN_UP
from impact_posture.system.arrays import Array


class PathPhase(IntEnum):
    """Phase of the motion along a path."""

    IDLE = 0
    """The path has not begun."""
    APPROACH = 1
    """On the way to the run-up, or waiting before it; without a strike, on the way to the end."""
    RUN_UP = 2
    LATE = 3
    """The contact is late: the references continue with the velocity of the impact."""
    FOLLOW_THROUGH = 4
    """The contact has happened: the references follow the stop after the impact."""
    HOLD = 5
    """The robot rests at the end of the path."""


class PathReference:
    """References of a controller along a path, which switch to the follow-through at the contact.

    The references wait where the path is last at rest: at the beginning of the run-up, or at the start if the path is
    in one piece.  The run-up ends at the expected time of the contact.  Until the contact, the references continue
    with the velocity of the impact for at most the time ``late``.  The contact is noticed in the run-up, at the first
    of three events:

    1. A measured force exceeds ``felt``.
    2. Every contact point has less than the share ``stopped`` of its planned speed, both computed with the Jacobian
       at the planned contact.
    3. The contact is later than expected by the time ``late``.

    Then the references follow the stop after the impact.  The stop starts from the reference posture at the contact,
    or from the measured posture after the third event.  If the contact is early, the reference velocity is only a
    fraction of the planned velocity, and the velocity of the stop is scaled by this fraction.  Exported controllers
    in C contain the same references (:mod:`impact_posture.controller_export.path_source`).

    Attributes:
        path: The path.
        approach: Speed of each contact point towards the surface per generalized velocity, shape (m, nv), at the end
            of the path.  If the contact is not known, the entries are zero, and the second event (see above) never
            occurs.
        late: Longest time for which the references continue after the expected contact, s.
        felt: Force above which a contact is felt, N.
        stopped: The contact is noticed if every contact point has less than this share of its planned speed.
        again: Time of the path at whose posture the references wait after :meth:`back`, s.
        lag: Time by which the accelerations are ahead of postures and velocities, s, because the thrust of rotors
            lags behind its command.
        phase: Phase at the last tick.
        moment: References of the last tick: posture, velocity and acceleration.
    """

    LATE, FELT, STOPPED = 0.075, 5.0, 0.5

    def __init__(self, path: PosturePath, approach: Array | None = None, lag: float = 0.0) -> None:
        self.path, self.lag = path, lag
        self.approach = np.zeros((1, path.model.nv)) if approach is None else np.atleast_2d(approach)
        self.late, self.felt, self.stopped = self.LATE, self.FELT, self.STOPPED
        strike = path.strike
        one_piece = strike is not None and strike.rest_s < strike.run_up_s
        half, rest = max(path.duration - RUN_UP / 2, 0.0), path.duration if strike is None else strike.rest_s
        self.again = half if one_piece else rest
        self._stop = None if strike is None or strike.follow_through is None else strike.follow_through.rows
        self._rest = np.zeros(path.model.nv)
        self.reset()

    def reset(self) -> None:
        """Return to the beginning of the path, and wait there."""
        self.phase, self.moment = PathPhase.IDLE, (self.path.q[0], self._rest, self._rest)
        strike, end = self.path.strike, self.path.duration
        # Time of the path at which the references wait, and times from there and from the beginning of the run-up to
        # the contact.
        self._wait = end if strike is None else strike.rest_s
        self._ahead, self._run_up = end - self._wait, end - (strike.run_up_s if strike else end)
        self._slower = False
        # Motion to the posture of waiting, its duration, and the time when it begins.
        self._way: RowInterpolation = self.path
        self._until, self._begin, self._now = self._wait, np.inf, -np.inf
        # Time of the expected contact, time of the noticed contact, posture at the noticed contact, and share of the
        # planned velocity there.
        self._expected, self._hit, self._contact, self._share = np.inf, np.inf, self.path.q[-1], 1.0

    def start(self, t: float, contact: float = -np.inf) -> None:
        """Begin the path at time ``t``, s; ``contact`` is as in :meth:`expect`."""
        self.reset()
        self._begin = self._now = t
        self.expect(contact)

    def expect(self, contact: float) -> None:
        """Make the run-up end at time ``contact``, s, or as soon as possible after it.

        ``-inf`` means as soon as possible, and ``inf`` means to wait.  The call has no effect without a strike,
        before :meth:`start`, or after the end of the wait.
        """
        if self.path.strike is not None and self._begin < np.inf and not self._strikes(self._now):
            self._expected = max(contact, max(self._begin + self._until, self._now) + self._ahead)

    def back(self, over: float) -> None:
        """Return to the posture at the time ``again`` of the path within ``over`` seconds; wait for :meth:`expect`.

        From there, the next run-up begins at rest.  On a path in one piece, it takes :data:`RUN_UP` for the last half
        of this time.  Before the contact, the call has no effect.
        """
        if self._hit < np.inf:
            if self.again > self._wait:
                self._wait, self._slower = self.again, True
                self._ahead = self._run_up = 2 * (self.path.duration - self.again)
            ends, rest = np.array([self.moment[0], self.path.at(self._wait)[0]]), np.zeros((2, len(self._rest)))
            self._way = RowInterpolation(self.path.model, np.array([0.0, over]), ends, rest, rest)
            self._until, self._begin, self._hit, self._expected = over, self._now, np.inf, np.inf
            self.phase = PathPhase.APPROACH

    def tick(self, t: float, q: Array, v: Array, force: float | None = None) -> Moment:
        """Return posture, velocity and acceleration of the references at time ``t``, s.

        Args:
            t: Time, s.
            q: Measured posture, shape (nq,).
            v: Measured generalized velocity ``ν``, shape (nv,).
            force: Measured contact force, N; ``None`` without a force sensor.
        """
        self._now = t
        if self._strikes(t) and self._hit == np.inf:
            planned, speed, _ = self._at(t)
            late = t > self._expected + self.late
            if late or (self.phase != PathPhase.APPROACH and self._touches(speed, v, force)):
                self._hit, self._contact = t, q if late else planned
                # The velocity after an impact is proportional to the velocity before.
                whole = self.path.v[-1]
                self._share = 1.0 if late else float(np.clip(speed @ whole / (whole @ whole), 0.0, 1.0))
        ahead = self._at(t + self.lag)[2]
        q, v, _ = self._at(t)
        self.moment = q, v, ahead
        return self.moment

    def _touches(self, planned: Array, v: Array, force: float | None) -> bool:
        if force is not None and force > self.felt:
            return True
        assert self.path.strike is not None  # noqa: S101 (only a strike touches)
        speed, wanted = float((self.approach @ v).max()), float((self.approach @ planned).max())
        # At the beginning of the run-up, the planned speed is too small for a comparison.
        return speed < self.stopped * wanted > self.stopped**2 * self.path.strike.speed

    def _strikes(self, t: float) -> bool:
        return t >= self._expected - self._ahead

    def _before(self, late: float) -> Moment:
        """Return the references at the time ``late ≤ 0`` after the expected contact.

        After a return on a path in one piece, the pace along the path rises from 0 to 1 as ``3τ² − 2τ³``.
        """
        if not self._slower:
            return self.path.at(self.path.duration + late)
        x = 1 + late / self._ahead
        pace, rise = x**2 * (3 - 2 * x), 6 * x * (1 - x) / self._ahead
        q, v, a = self.path.at(self._wait + x**3 * (1 - x / 2) * self._ahead)
        return q, v * pace, a * pace**2 + v * rise

    def _at(self, t: float) -> Moment:
        """Set the phase and return the references at time ``t``."""
        model, rest = self.path.model, self._rest
        if self._begin == np.inf:
            return self.moment
        if not self._strikes(t):
            here, done = t - self._begin, t - self._begin >= self._until
            self.phase = PathPhase.HOLD if done and self.path.strike is None else PathPhase.APPROACH
            q, v, a = self._way.at(min(here, self._until))
            return (q, rest, rest) if done else (q, v, a)
        if self._hit == np.inf:
            late = t - self._expected
            near = t >= self._expected - self._run_up
            self.phase = PathPhase.LATE if late > 0 else PathPhase.RUN_UP if near else PathPhase.APPROACH
            q, v, a = self._before(min(late, 0.0))
            return (q, v, a) if late <= 0 else (np.array(pin.integrate(model, q, late * v)), v, rest)
        q, v, a = (self.path.q[-1], rest, rest) if self._stop is None else self._stop.at(t - self._hit)
        done = self._stop is None or t - self._hit >= self._stop.t[-1]
        self.phase = PathPhase.HOLD if done else PathPhase.FOLLOW_THROUGH
        away = self._share * pin.difference(model, self.path.q[-1], q)
        q = np.array(pin.integrate(model, self._contact, away))
        return (q, rest, rest) if done else (q, self._share * v, self._share * a)

    @property
    def level(self) -> float:
        """Elapsed share of the path to the contact, 0 to 1."""
        if self.phase in (PathPhase.IDLE, PathPhase.APPROACH):
            elapsed = min(max(self._now - self._begin, 0.0) / self._until, 1.0) if self._until else 1.0
            return 0.0 if self.phase == PathPhase.IDLE else elapsed * self._wait / self.path.duration
        return 1.0
