"""Progress along a curve over time, with accelerations that do not jump."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from impact_posture.system.arrays import Array

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

# A jump of the acceleration becomes a ramp of this duration, s.
RAMP = 2e-3
# Largest duration of a ramp, as a share of the duration of the motion.
_SHARE = 0.05
# Decimals of a time in seconds, because the times of a ``JointTrajectory`` are whole nanoseconds.
DIGITS = 9
# No row is placed at a jump of ``s̈`` that is below this fraction of the largest jump.
_BEND = 0.02


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """The progress ``s(t)`` of a motion, from 0 at ``t = 0`` to 1 at the end.

    Attributes:
        progress: Polynomials of ``s`` over time.
        duration: Duration, s.
        bends: Times at which ``s̈`` starts or stops changing, s.
    """

    progress: PPoly
    duration: float
    bends: Array = field(default_factory=lambda: np.zeros(0))

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Return ``s``, ``ṡ`` and ``s̈`` at times, shape (n,)."""
        s, ds, dds = (self.progress(t, order) for order in range(3))
        return s, ds, dds

    def when(self, s: float) -> float:
        """Return the first time at which the progress is ``s``, s."""
        return float(self.progress.solve(s, extrapolate=False)[0])


def polynomial(coefficients: Array, duration: float) -> TimeLaw:
    """Return the law whose ``s`` is a polynomial of ``t/T``, with ``coefficients`` from the highest power on."""
    from scipy.interpolate import PPoly

    duration, powers = whole(duration), np.arange(len(coefficients))[::-1]
    scaled = coefficients / duration**powers
    return TimeLaw(PPoly(scaled[:, None], np.array([0.0, duration])), duration)


def stepped(s: Array, rates: Array) -> TimeLaw:
    """Return the law with the speeds ``ṡ`` at places ``s``, both of shape (n,), from rest.

    Between two places, ``s̈`` is constant.  At the places, ``s̈`` would jump, and an interpolation of rows would
    overshoot.  So ``s`` is averaged over :data:`RAMP`, and ``s̈`` changes linearly.  An average of speeds and
    accelerations exceeds no limit, because the limits are convex and hardly change in this time.  If the motion does
    not end at rest, ``ṡ`` must be constant before its end, and the end value of ``ṡ`` is exact.
    """
    from scipy.interpolate import PPoly

    ends = np.append(0.0, np.cumsum(2 * np.diff(s) / (rates[1:] + rates[:-1])))
    # A motion that does not end at rest would continue beyond the last place, which the average passes half a ramp
    # later.
    part = 2 if rates[-1] else 1
    duration = whole(float(ends[-1]) + min(RAMP, _SHARE * float(ends[-1])) / part)
    ramp = part * (duration - float(ends[-1]))
    t = np.unique([*ends, *(ends + ramp)])
    dds = (np.interp(t, ends, rates) - np.interp(t - ramp, ends, rates)) / ramp
    progress = PPoly(np.array([np.diff(dds) / np.diff(t), dds[:-1]]), t).antiderivative(2)
    jumps = np.abs(np.diff(np.diff(rates) / np.diff(ends), prepend=0.0, append=0.0))
    at = ends[jumps > _BEND * jumps.max()]
    return TimeLaw(progress, duration, np.unique(np.append(at, at + ramp).round(DIGITS)))


def whole(duration: float) -> float:
    """Return a duration that is rounded up to the digits of a time, s."""
    return float(np.ceil(duration * 10**DIGITS - 1e-4) / 10**DIGITS)
