"""Motions along a curve: times, velocities and accelerations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.system.arrays import Array

# Largest time between two points of a trajectory, s, and the least number of points.
SAMPLE_TIME, _LEAST_POINTS = 0.01, 21


@dataclass(frozen=True, eq=False)
class TimedCurve:
    """A motion along a curve: times, s, shape (n,), velocities ``ν`` and accelerations ``ν̇``, shape (n, nv).

    Attributes:
        z: Tangent coordinates on the curve, shape (n, nv).
        method: ``time-optimal`` (fixed base), ``scaled`` (one time scale for the whole motion) or ``slowed`` (slower
            at corners of the curve).
        notes: Limits that the motion does not respect, and why.
    """

    t: Array
    z: Array
    v: Array
    a: Array
    method: str
    notes: tuple[str, ...] = ()


def times(duration: float) -> Array:
    """Return the times of a trajectory, evenly from zero, s."""
    return np.linspace(0.0, duration, max(_LEAST_POINTS, int(np.ceil(duration / SAMPLE_TIME)) + 1))
