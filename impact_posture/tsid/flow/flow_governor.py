"""Changes of the velocity of the reference flow, which decrease the objective and respect all limits."""

from __future__ import annotations

import math

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.flow_direction import FlowDirection, FlowOptions
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.flow.zero_moment_point import ZeroMomentPoint

# Number of attempts per candidate of ``change``: the candidate, then twice what remains within the limits.
ATTEMPTS = 3
# The flow assumes a fraction of the largest acceleration for braking.  This fraction is at least ``ABLE``, and
# increases by at most ``ABLE`` per change.
ABLE = 0.1
# Safety factor of the braking time, because the slopes of the limits change during braking.
CAUTION = 1.5
# The speed of the flow is at most this multiple of the step ``δ``, 1/s.
RATE = 4.8
# Smallest divisor when a speed is divided by a step, rad (m); prevents a division by zero.
_TINY = 1e-12
# Time constant with which ``q_r`` returns to the contacts and to the targets of the tasks, s.
RETURN = 0.1


class FlowGovernor:
    """Velocity of the reference flow that keeps the constraints, and the permitted changes of this velocity.

    Attributes:
        flow: Velocity ``u`` of the flow, without the part that returns to the constraints, rad/s (m/s), shape (nv,).
        returning: Velocity of the return to the constraints, rad/s (m/s), shape (nv,).
    """

    def __init__(self, direction: FlowDirection, options: FlowOptions) -> None:
        """Begin at rest; ``direction`` provides the limits and the curvature."""
        self._direction, self._options, self._able = direction, options, 1.0
        self.flow, self.returning = np.zeros((2, direction.B.shape[0]))

    def back(self, remaining: Array, period: float) -> Array:
        """Update :attr:`returning` for the next ``period`` seconds and return it, shape (nv,).

        ``remaining`` is the displacement that leads back to the constraints, shape (nv,).  Speed and acceleration
        stay within their limits.
        """
        options, size = self._options, max(float(np.abs(remaining).max(initial=0.0)), _TINY)
        # The deceleration ``2a/5`` stops a motion with the speed ``√(4ad/5)`` within the distance ``d``.
        pace = min(1.0 / RETURN, math.sqrt(0.8 * options.acceleration / size), options.speed / size)
        self.returning += limited(pace * remaining - self.returning, options.acceleration * period)
        return self.returning

    def stopping(self, flow: Array) -> float:
        """Return the time ``T``, s, in which a constant deceleration stops a motion with the velocity ``flow``.

        The braking distance is ``flow·T/2``.
        """
        return float(np.abs(flow).max()) / self._options.acceleration

    def change(
        self, space: Redundancy, step: Array, fastest: float, period: float, slope: Array | None, zmp: ZeroMomentPoint
    ) -> tuple[Array, bool]:
        """Return the change of the velocity towards a step, shape (nv,), and whether the change only brakes.

        The function tries three candidates:

        1. Each joint uses its full acceleration, and the change is projected onto the motions that keep the
           constraints.  Unless the change slows the flow down, the part that moves the zero moment point too far is
           removed.
        2. The velocity changes straight towards the wanted velocity.
        3. The velocity decreases without a change of direction.

        Candidates 1 and 2 have three attempts; the last two attempts leave out the part that crosses limits.  The
        result is the first attempt after which the flow can stop within the limits.  The flow assumes the
        deceleration that the actuators permitted in the last changes.

        ``step`` is ``δ``, shape (nv,).  ``fastest`` is the largest speed of an entry, rad/s (m/s).  The velocity
        changes within ``period`` seconds.  If ``slope`` is ``∇H/H₀``, shape (nv,), the change must not increase
        ``H``; ``None`` permits an increase.
        """
        options, direction, Z, flow = self._options, self._direction, space.basis, self.flow
        most = options.acceleration * period
        # The deceleration ``2a/5`` stops a motion with the speed ``√(4aδ/5)`` within the step ``δ``.
        pace = min(math.sqrt(0.8 * options.acceleration / max(np.abs(step).max(), _TINY)), RATE)
        away = limited(pace * step, fastest) - flow
        # The displacement ``stop`` is twice the braking distance, because the curvature may increase during braking.
        stop = flow * self.stopping(flow)
        fast = space.project(np.minimum(np.maximum(away, -most), most))
        for change, keeps in ((fast, True), (away, False)):
            change = limited(change, most)
            for attempt in range(ATTEMPTS):
                if keeps and float(change @ flow) >= 0:
                    change = zmp.keep(space, period, change)
                if attempt:
                    change = direction.along(Z, flow, self._braking(change, period), change)
                if slope is not None:
                    change = direction.downhill(Z, slope, flow, stop, change)
                change = limited(self._within_speed(change), most)
                if direction.stops(flow + change, self._braking(change, period)):
                    return change, False
        return limited(-flow, most), True

    def take(self, change: Array, part: float) -> Array:
        """Add ``part`` times ``change`` to the velocity, and return this product, shape (nv,).

        ``part`` is the fraction of the change that the actuators permit, 0 to 1.
        """
        self._able = min(max(part, ABLE), self._able + ABLE)
        change = change * part
        self.flow = self.flow + change
        return change

    def _within_speed(self, change: Array) -> Array:
        """Return a change after which the flow is within its speed limit.

        The change may exceed the speed limit, because the removal of a part that crosses a limit can speed up other
        joints.
        """
        after, fastest = self.flow + change, self._options.speed
        return limited(after, fastest) - self.flow if np.abs(after).max(initial=0.0) > fastest else change

    def _braking(self, change: Array, period: float) -> float:
        """Return the time, s, in which the changed velocity covers the distance of change and later braking."""
        return CAUTION * self.stopping(self.flow + change) / 2 / self._able + period


def limited(vector: Array, largest: float) -> Array:
    """Return the vector, scaled down so that no absolute value of an entry exceeds ``largest``."""
    size = float(np.abs(vector).max(initial=0.0))
    return vector * (largest / size) if size > largest else vector
