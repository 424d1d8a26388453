"""Joint position and velocity limits as bounds on the joint accelerations of one tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, NonNegative, Positive
from impact_posture.errors import InputError
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.tsid.joint_ranges import JointRanges
from impact_posture.tsid.state import State


@checked
@dataclass(frozen=True)
class LimitLaw:
    """Law that stops joints at their limits.

    At distance ``x`` from a limit, a joint may move towards the limit with at most the speed ``φ(x) = min(approach·x,
    √(2·deceleration·x), velocity limit)``.  Beyond the limit, the joint must return with the speed ``φ``.  The bounds
    of the acceleration are ``rate·(−φ(q − q_min) − q̇) ≤ q̈ ≤ rate·(φ(q_max − q) − q̇)``.  ``φ`` is odd and
    increasing, so the lower bound never exceeds the upper bound, inside the limits or outside.

    Attributes:
        approach: Permitted speed towards a limit, divided by the distance from the limit, 1/s.
        rate: Permitted acceleration, divided by the difference between the permitted and the present speed, 1/s.
            ``rate`` is at least ``4·approach``; otherwise, a joint could swing through its limit.
        deceleration: Deceleration available for braking, rad/s² (m/s²).
        acceleration: Largest acceleration of a joint, rad/s² (m/s²); infinite means no bound.
        margin: Distance from a position limit at which joints stop, rad (m); limited to a quarter of the joint's
            range.
    """

    approach: Positive = 10.0
    rate: float = 50.0
    deceleration: Positive = 50.0
    acceleration: Annotated[float, Demand(lambda value: value > 0, "a number above zero")] = np.inf
    margin: NonNegative = 0.0

    def __post_init__(self) -> None:
        """Raise :class:`InputError` if the law does not stop the joints."""
        if not self.rate >= 4 * self.approach:
            what = f"'rate' is {self.rate:g}, below four times 'approach' ({self.approach:g})"
            raise InputError(what, where="limit law", hint="raise 'rate' or lower 'approach'")


class AccelerationBounds:
    """Bounds on the accelerations at a state, computed by a :class:`LimitLaw`.

    Attributes:
        lower: Lower bounds of the accelerations, rad/s² (m/s²), shape (nv,); minus infinity means no bound.
        upper: Upper bounds, rad/s² (m/s²), shape (nv,); infinity means no bound.
    """

    def __init__(self, robot: Robot, law: LimitLaw, lower: Array | None = None, upper: Array | None = None) -> None:
        """Store the bounds in the arrays ``lower`` and ``upper``, shape (nv,), or in new arrays for ``None``."""
        ranges, nv = JointRanges(robot), robot.nv
        self.law = law
        self.lower = np.full(nv, -np.inf) if lower is None else lower
        self.upper = np.full(nv, np.inf) if upper is None else upper
        self._fastest = ranges.velocity
        self._size, self._speed, self._signed = np.zeros((3, 2, nv))
        self._braking, self._margin = np.zeros(nv), np.minimum(law.margin, (ranges.upper - ranges.lower) / 4)
        self._to_upper, self._to_lower = self._speed
        self._twice = np.sqrt(2 * law.deceleration)
        # The six accelerations of a floating base have no limits.
        self._largest = np.full(nv, law.acceleration)
        self._largest[: robot.first_joint] = np.inf

    def update(self, state: State) -> None:
        """Compute the bounds at ``state``."""
        law, size, speed, signed = self.law, self._size, self._speed, state.room
        if law.margin:
            signed = np.subtract(signed, self._margin, out=self._signed)
        inside = state.least_room >= law.margin
        room = signed if inside else np.abs(signed)
        np.sqrt(room, out=speed)
        speed *= self._twice
        np.multiply(room, law.approach, out=size)
        np.minimum(speed, size, out=speed)
        np.minimum(speed, self._fastest, out=speed)
        if not inside:
            np.copysign(speed, signed, out=speed)
        speed *= law.rate
        np.multiply(state.v, law.rate, out=self._braking)
        self._to_upper -= self._braking
        self._to_lower += self._braking
        if law.acceleration < np.inf:
            np.minimum(speed, self._largest, out=speed)
            np.maximum(speed, -self._largest, out=speed)
        self.upper[:] = self._to_upper
        np.negative(self._to_lower, out=self.lower)
