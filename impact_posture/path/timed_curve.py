"""Motions along a curve as rows that are dense enough for the interpolation between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np

from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.path_curve import PathCurve
from impact_posture.path.path_space import PathSpace
from impact_posture.path.row_interpolation import Moment, RowInterpolation
from impact_posture.path.time_law import DIGITS, TimeLaw
from impact_posture.system.arrays import Array

# Largest time between two rows, s.
SAMPLE_TIME = 0.01
# Least number of rows.
_LEAST_POINTS = 21
# Instants between two rows at which the interpolation is compared with the motion, as shares of the interval.
BETWEEN = (0.2, 0.5, 0.8)
# Largest difference between the load of the interpolation and the load of the motion, relative to the load limit.
_DIFFERENCE = 0.004
# Largest number of times that an interval is divided.
_CUTS = 10
# For a load without a limit, the difference is relative to the largest value of this load, or to this fraction of the
# largest value of all loads if that is greater.
_SMALL = 0.01

Row = tuple[float, Moment]


@dataclass(frozen=True, eq=False)
class TimedCurve:
    """A motion along a curve.

    Attributes:
        rows: Rows on the curve, and the motion between them.
        method: ``time-optimal`` (fixed base), ``scaled`` (one time scale for the whole motion), ``slowed`` (slower
            at corners of the curve) or ``free fall``.
        notes: Limits that the motion does not respect, and why.
        law: Progress along the curve; ``None`` if the motion follows several curves.
    """

    rows: RowInterpolation
    method: str
    notes: tuple[str, ...] = ()
    law: TimeLaw | None = None

    @property
    def instants(self) -> Array:
        """Times of the rows and instants between them (:data:`BETWEEN`), s, for the check of limits."""
        return np.append(np.concatenate([a + (b - a) * np.array([0.0, *BETWEEN]) for a, b in pairwise(self.rows.t)]),
                         self.rows.t[-1])  # fmt: skip


def moment(curve: PathCurve, law: TimeLaw, t: float) -> Moment:
    """Return posture, velocity and acceleration at time ``t`` of the motion along a curve."""
    s, ds, dds = (float(x[0]) for x in law.at(np.array([t])))
    q, along, bent = curve.moment(s)
    return q, along * ds, bent * ds**2 + along * dds


def sampled(
    space: PathSpace, curve: PathCurve, limits: ActuatorLimits, law: TimeLaw, method: str, notes: tuple[str, ...] = ()
) -> TimedCurve:
    """Return the motion along a curve with a time law.

    The rows are at most :data:`SAMPLE_TIME` apart.  If the loads of the interpolation between two rows differ from
    the loads of the motion, the interval is divided, preferably at a jump of ``s̈``.
    """
    step = min(SAMPLE_TIME, law.duration / (_LEAST_POINTS - 1))
    t = np.linspace(0.0, law.duration, int(np.ceil(law.duration / step - 1e-9)) + 1).round(DIGITS)
    bends, first = law.bends, [moment(curve, law, time) for time in t]
    effort, most = np.array(space.model.effortLimit), np.abs([limits.load(*each) for each in first]).max(axis=0)
    scale = np.where(np.isfinite(effort) & (effort > 0), effort, np.maximum(most, _SMALL * most.max()))

    def rows(start: Row, end: Row, cuts: int) -> Iterator[Row]:
        """Yield the row ``start`` and the rows between ``start`` and ``end``."""
        (a, _), (b, _) = start, end
        pair, times = _joined(space, [start, end]), a + (b - a) * np.array(BETWEEN)
        differences = [limits.load(*pair.at(time)) - limits.load(*moment(curve, law, time)) for time in times]
        if not cuts or (np.abs(differences) / scale).max() < _DIFFERENCE:
            yield start
            return
        inside = bends[(bends > a) & (bends < b)]
        cut = float(inside[np.abs(inside - times[1]).argmin()]) if inside.size else round(float(times[1]), DIGITS)
        middle = cut, moment(curve, law, cut)
        yield from rows(start, middle, cuts - 1)
        yield from rows(middle, end, cuts - 1)

    pieces = [rows(start, end, _CUTS) for start, end in pairwise(zip(t.tolist(), first, strict=True))]
    return TimedCurve(_joined(space, [*chain(*pieces), (t[-1], first[-1])]), method, notes, law)


def _joined(space: PathSpace, rows: Sequence[Row]) -> RowInterpolation:
    q, v, a = (np.array([each[k] for _, each in rows]) for k in range(3))
    return RowInterpolation(space.model, np.array([t for t, _ in rows]), q, v, a)
