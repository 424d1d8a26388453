"""Reference trajectory of the end effector for repeated contacts."""

from __future__ import annotations

from bisect import bisect_right
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from impact_posture.errors import InputError
from impact_posture.simulation.scenario_file import RepeatedContacts


class ReferencePoint(NamedTuple):
    """Distance from the start position (m), speed (m/s) and acceleration (m/s²) along the approach."""

    distance: float
    speed: float
    acceleration: float


class Reference:
    """Reference trajectory of :class:`RepeatedContacts` along ``−n``, into the surface.

    During the approach, the reference accelerates from rest with ``acceleration`` to ``speed`` and keeps this speed
    until it reaches the surface.  Behind the surface, the reference brakes uniformly to rest at the distance
    ``beyond``.  After the time ``dwell``, the reference returns to the start with the same acceleration and at most
    the same speed, and rests there for the time ``pause``.

    Attributes:
        inward: Duration of the approach, s.
        crossing: Time from the start of an approach until the reference reaches the surface, s.
        cycle: Time from the start of an approach to the start of the next approach, s.
        total: Duration of the run, s.
        legs: Segments of constant acceleration, each with duration (s), acceleration (m/s²), initial distance (m) and
            initial speed (m/s).

    Raises:
        InputError: The gap is too short to reach the speed.
    """

    def __init__(self, task: RepeatedContacts, gap: float) -> None:
        v, a = task.speed, task.acceleration
        # If ``v`` is huge, ``v * v`` is infinite, but ``v**2`` would raise an OverflowError.
        run_up = v * v / (2 * a)
        if not run_up <= gap:
            what = f"{v:g} m/s at {a:g} m/s² requires {run_up:.3g} m, but the gap is {gap:.3g} m"
            raise InputError(what, where="contacts", hint="increase the gap or the acceleration, or reduce the speed")
        depth, braking = gap + task.beyond, 2 * task.beyond / v
        top = min(v, float(np.sqrt(a * depth)))
        inward = [(v / a, a, 0.0, 0.0), ((gap - run_up) / v, 0.0, run_up, v)]
        if braking:
            inward.append((braking, -v / braking, gap, v))
        rest = [
            (task.dwell, 0.0, depth, 0.0),
            (top / a, -a, depth, 0.0),
            ((depth - top**2 / a) / top, 0.0, depth - top**2 / (2 * a), -top),
            (top / a, a, top**2 / (2 * a), -top),
            (task.pause, 0.0, 0.0, 0.0),
        ]
        self.task, self.legs = task, (*inward, *rest)
        self._ends = [float(end) for end in accumulate(leg[0] for leg in self.legs)]
        self.crossing = self._ends[1]
        self.inward, self.cycle = self._ends[len(inward) - 1], self._ends[-1]
        self.total = task.settle + task.count * self.cycle

    def start(self, contact: int) -> float:
        """Return the time at which the approach to contact number ``contact`` begins, s."""
        return float(self.task.settle + contact * self.cycle)

    def at(self, t: float) -> ReferencePoint:
        """Return the reference at time ``t``, s."""
        contact = min(max(int((t - self.task.settle) // self.cycle), 0), self.task.count - 1)
        since = t - self.start(contact)
        k = bisect_right(self._ends, since)
        if since < 0 or k == len(self.legs):
            return ReferencePoint(0.0, 0.0, 0.0)
        duration, acceleration, distance, speed = self.legs[k]
        s = since - (self._ends[k] - duration)
        return ReferencePoint(distance + speed * s + acceleration * s**2 / 2, speed + acceleration * s, acceleration)
