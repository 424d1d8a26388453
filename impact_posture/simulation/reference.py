"""Where the end effector of repeated contacts is asked to be, over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.errors import InputError
from impact_posture.simulation.scenario import RepeatedContacts


@dataclass(frozen=True)
class ReferencePoint:
    """Along the way in, from where the shape is at the start.

    Attributes:
        distance: m.
        speed: m/s.
        acceleration: m/s².
        contact: Which contact it belongs to, from 0; −1 while the robot settles.
    """

    distance: float
    speed: float
    acceleration: float
    contact: int


class Reference:
    """The reference of :class:`RepeatedContacts` along ``−n``.

    In: from rest with ``acceleration`` to ``speed``, on at ``speed`` to the surface, and braking evenly to rest
    ``beyond`` it.  It stays for ``dwell``, comes back from rest to rest with the same acceleration and at most the
    same speed, and pauses.

    Attributes:
        task: What happens.
        inward: Seconds that the way in takes.
        back: Seconds that the way back takes.
        cycle: Seconds from one approach to the next.
        total: Seconds of the whole run.

    Args:
        task: What happens.
        gap: Distance of shape and surface at the start, m.

    Raises:
        InputError: The gap is too short to come up to speed in.
    """

    def __init__(self, task: RepeatedContacts, gap: float) -> None:
        v, a = task.speed, task.acceleration
        run_up = v**2 / (2 * a)
        if not run_up <= gap:
            raise InputError(
                f"{v:g} m/s at {a:g} m/s² takes {run_up:.3g} m, the gap is {gap:.3g} m",
                where="contacts",
                hint="widen the gap, slow down, or accelerate more",
            )
        self.task, self._gap = task, gap
        self._depth = gap + task.beyond
        # Legs of constant acceleration: for how long, which, from what speed.
        braking = 2 * task.beyond / v
        self._in = [(v / a, a, 0.0), ((gap - run_up) / v, 0.0, v)]
        if braking:
            self._in.append((braking, -v / braking, v))
        top = min(v, float(np.sqrt(a * self._depth)))
        cruise = (self._depth - top**2 / a) / top
        self._back = [(top / a, -a, 0.0), (cruise, 0.0, -top), (top / a, a, -top)]
        self.inward = sum(leg[0] for leg in self._in)
        self.back = sum(leg[0] for leg in self._back)
        self.cycle = self.inward + task.dwell + self.back + task.pause
        self.total = task.settle + task.count * self.cycle

    def start(self, contact: int) -> float:
        """When the approach of a contact begins, s."""
        return float(self.task.settle + contact * self.cycle)

    def at(self, t: float) -> ReferencePoint:
        """The reference at a time, s."""
        contact = int(np.floor((t - self.task.settle) / self.cycle))
        if contact < 0:
            return ReferencePoint(0.0, 0.0, 0.0, -1)
        contact = min(contact, self.task.count - 1)
        since = t - self.start(contact)
        if since < self.inward:
            return _along(self._in, since, 0.0, contact)
        since -= self.inward + self.task.dwell
        if since < 0:
            return ReferencePoint(self._depth, 0.0, 0.0, contact)
        if since < self.back:
            return _along(self._back, since, self._depth, contact)
        return ReferencePoint(0.0, 0.0, 0.0, contact)


def _along(legs: list[tuple[float, float, float]], since: float, distance: float, contact: int) -> ReferencePoint:
    for duration, acceleration, speed in legs:
        t = min(since, duration)
        distance += speed * t + acceleration * t**2 / 2
        if since < duration:
            return ReferencePoint(distance, speed + acceleration * t, acceleration, contact)
        since -= duration
    return ReferencePoint(distance, 0.0, 0.0, contact)
