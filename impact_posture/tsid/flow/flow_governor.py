"""Changes of the velocity of the reference flow, limited in speed and acceleration, downhill and within limits."""

from __future__ import annotations

import math

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.flow_direction import FlowDirection, FlowOptions
from impact_posture.tsid.flow.redundancy import Redundancy
from impact_posture.tsid.flow.zero_moment_point import ZeroMomentPoint

# Number of attempts for a change: as it is, then twice without the part that crosses limits.
_ATTEMPTS = 3
# Least share of the acceleration that counts as available for braking.  A change can raise the share by this much.
_ABLE = 0.1
# Factor of the braking time, because the slopes of the limits change during braking.
_CAUTION = 1.5
# Largest ratio of the speed of the flow to its step, 1/s.
_RATE = 4.8
# Least size of a step that divides a speed, rad (m).
_TINY = 1e-12
# Time constant of the return to contacts and tasks, s.
_RETURN = 0.1


class FlowGovernor:
    """Velocity of the reference flow on the constraints, and its changes.

    Attributes:
        flow: ``u`` without the return to the constraints, rad/s (m/s), shape (nv,).
        returning: Velocity of the return, shape (nv,).
    """

    def __init__(self, direction: FlowDirection, options: FlowOptions) -> None:
        """Begin at rest, with the limits and the curvature of ``direction``."""
        self._direction, self._options, self._able = direction, options, 1.0
        self.flow, self.returning = np.zeros((2, direction.B.shape[0]))

    def back(self, remaining: Array, period: float) -> Array:
        """Change the velocity of the return for ``period`` seconds, within speed and acceleration, and return it.

        ``remaining`` is the displacement that leads back to the constraints.  Both have the shape (nv,).
        """
        options, size = self._options, max(float(np.abs(remaining).max(initial=0.0)), _TINY)
        # Two fifths of the acceleration stop a speed of sqrt(4/5 a d) within the distance d.
        pace = min(1.0 / _RETURN, math.sqrt(0.8 * options.acceleration / size), options.speed / size)
        self.returning += limited(pace * remaining - self.returning, options.acceleration * period)
        return self.returning

    def stopping(self, flow: Array) -> float:
        """Return the time in which a flow stops evenly, s.  Going on for this time is twice the braking distance."""
        return float(np.abs(flow).max()) / self._options.acceleration

    def change(
        self, space: Redundancy, step: Array, fastest: float, period: float, slope: Array | None, zmp: ZeroMomentPoint
    ) -> tuple[Array, bool]:
        """Return the change of the flow towards a step, shape (nv,), and whether it only brakes.

        There are three candidates.  In the first, each joint changes as fast as it can, projected on the constraints.
        In the second, all joints change evenly.  In the third, all joints brake evenly.  The first two have three
        attempts each, of which the last two leave out the part that crosses limits.  The first candidate also leaves
        out the part that moves the zero moment point too far, unless it slows the flow down.  The result is the first
        attempt from which the flow can stop within the limits, by braking evenly as hard as it lately could.

        The step is ``δ``, shape (nv,).  No entry gets faster than ``fastest``, rad/s (m/s), and the flow changes for
        ``period`` seconds.  It must not climb along the slope ``∇H/H₀``, shape (nv,), unless the slope is ``None``.
        """
        options, direction, Z, flow = self._options, self._direction, space.basis, self.flow
        most = options.acceleration * period
        # Two fifths of the acceleration stop a speed of √(4/5 a δ) within the step δ.
        pace = min(math.sqrt(0.8 * options.acceleration / max(np.abs(step).max(), _TINY)), _RATE)
        away = limited(pace * step, fastest) - flow
        # Twice the braking distance, because the curvature may grow on it.
        stop = flow * self.stopping(flow)
        fast = space.project(np.minimum(np.maximum(away, -most), most))
        for change, keeps in ((fast, True), (away, False)):
            change = limited(change, most)
            for attempt in range(_ATTEMPTS):
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
        """Change the flow by the part of a change that the actuators permit, and return the part, shape (nv,)."""
        self._able = min(max(part, _ABLE), self._able + _ABLE)
        change = change * part
        self.flow = self.flow + change
        return change

    def _within_speed(self, change: Array) -> Array:
        """Return a change that leaves the flow within its speed limit.

        A limit takes a part out of the change of all joints.  This can speed up one of them.
        """
        after, fastest = self.flow + change, self._options.speed
        return limited(after, fastest) - self.flow if np.abs(after).max(initial=0.0) > fastest else change

    def _braking(self, change: Array, period: float) -> float:
        """Return the time for which the flow goes on if it changes and then brakes evenly, s."""
        return _CAUTION * self.stopping(self.flow + change) / 2 / self._able + period


def limited(vector: Array, largest: float) -> Array:
    """Return the vector, shortened so that no entry exceeds ``largest``."""
    size = float(np.abs(vector).max(initial=0.0))
    return vector * (largest / size) if size > largest else vector
