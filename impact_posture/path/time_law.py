"""Progress along a curve over time, with accelerations that do not jump."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from impact_posture.system.arrays import Array

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

# A jump of the acceleration becomes a ramp of this duration, s, which is at most this share of the motion.
RAMP, _SHARE = 2e-3, 0.05
# Decimals of a time in seconds, because the times of a ``JointTrajectory`` are whole nanoseconds.
DIGITS = 9
# A jump of ``s̈`` below this share of the largest jump needs no row of its own.
_BEND = 0.02


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """The progress ``s(t)`` of a motion, from 0 at ``t = 0`` to 1 at the end.

    Attributes:
        progress: Polynomials of ``s`` over time, which end one second after the motion.
        duration: Duration, s.
        ramp: Time ``w`` over which ``s`` is averaged, s: ``(1/w) ∫ s dt`` from ``t − w`` to ``t``.  Zero means no
            averaging.
    """

    progress: PPoly
    duration: float
    ramp: float = 0.0

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Return ``s``, ``ṡ`` and ``s̈`` at times, shape (n,)."""
        if not self.ramp:
            s, ds, dds = (self.progress(t, order) for order in range(3))
            return s, ds, dds
        before = [self.progress.antiderivative(), self.progress, self.progress.derivative()]
        s, ds, dds = ((each(t) - each(t - self.ramp)) / self.ramp for each in before)
        return s, ds, dds

    @property
    def bends(self) -> Array:
        """Times at which ``s̈`` begins or ends to change, s."""
        breaks = self.progress.x
        curvature = 2 * self.progress.c[-3]
        jump = np.abs(np.diff(curvature))
        at = breaks[1:-1][jump > _BEND * jump.max(initial=0.0)]
        return np.unique(np.concatenate([at, at + self.ramp]).round(DIGITS)) if self.ramp else np.zeros(0)


def polynomial(coefficients: Array, duration: float) -> TimeLaw:
    """Return the law whose ``s`` is a polynomial of ``t/T``, with ``coefficients`` from the highest power on."""
    from scipy.interpolate import PPoly

    duration, powers = _whole(duration), np.arange(len(coefficients))[::-1]
    scaled = coefficients / duration**powers
    return TimeLaw(PPoly(scaled[:, None], np.array([0.0, duration])), duration)


def stepped(s: Array, rates: Array) -> TimeLaw:
    """Return the law with the speeds ``ṡ`` at places ``s``, both of shape (n,), from rest to rest.

    Between two places, ``s̈`` is constant.  At the places, ``s̈`` would jump, and an interpolation of rows would
    overshoot.  So ``s`` is averaged over :data:`RAMP`, and ``s̈`` changes linearly.  An average of speeds and
    accelerations exceeds no limit, because the limits are convex and hardly change in this time.
    """
    from scipy.interpolate import PPoly

    passed = np.array([2 * d / (a + b) for d, (a, b) in zip(np.diff(s), pairwise(rates), strict=True)])
    ends = np.concatenate([[0.0], np.cumsum(passed)])
    c = np.array([np.diff(rates) / passed / 2, rates[:-1], s[:-1]])
    rest = np.zeros((3, 1))
    c = np.hstack([rest, c, np.array([[0.0], [0.0], [1.0]])])
    ramp = min(RAMP, _SHARE * float(ends[-1]))
    duration = _whole(float(ends[-1]) + ramp)
    return TimeLaw(PPoly(c, np.concatenate([[-1.0], ends, [ends[-1] + 1.0]])), duration, duration - float(ends[-1]))


def _whole(duration: float) -> float:
    """Return a duration that is rounded up to the digits of a time, s."""
    return float(np.ceil(duration * 10**DIGITS) / 10**DIGITS)
