"""Motions along a curve that are slow at corners and within limits everywhere."""

from __future__ import annotations

import numpy as np

from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.path_curve import PathCurve
from impact_posture.path.path_space import PathSpace
from impact_posture.path.time_law import stepped
from impact_posture.path.timed_curve import SAMPLE_TIME, TimedCurve, sampled
from impact_posture.system.processes import fork_map

# A motion uses at most this share of the squared speed limits, and of the load that the limits leave beyond the load
# at rest.
_SHARE = 0.95
# Number of places that a process checks at a time.
_PLACES = 500


def slowed(space: PathSpace, curve: PathCurve, limits: ActuatorLimits, jobs: int = 1) -> TimedCurve | None:
    """Return a motion that is only as slow at each ``s`` as the limits require; ``None`` if they allow no motion.

    With ``x = ṡ²``, the load is ``g(s) + x c(s) + s̈ d(s)``, where ``g`` is the load of gravity.  The limits are
    convex.  The limits therefore allow ``(x, s̈)`` if ``x`` is at most half of its limit at ``s̈ = 0``, and ``s̈`` at
    most half of its limit at ``x = 0``.  One forward and one backward pass with ``dx/ds = 2 s̈`` give the largest
    such ``x(s)`` (Bobrow et al. 1985).  Between two knots, the second derivative of the curve is linear, so the
    limits are checked at only a few values of ``s``, most of them at corners.  ``jobs`` processes check them.
    """
    s = curve.places
    parts = np.array_split(s, max(1, len(s) // _PLACES))

    def bounds(part: int) -> list[tuple[float, float]] | None:
        """Return the largest ``x`` and ``s̈`` at each ``s`` of a part; ``None`` if the limits allow no motion."""
        pairs = [_bounds(space, curve, limits, place) for place in parts[part].tolist()]
        return None if None in pairs else [pair for pair in pairs if pair is not None]

    pairs_of: dict[int, list[tuple[float, float]]] = {}
    with fork_map(bounds, len(parts), jobs) as results:
        for part, pairs in results:
            if pairs is None:
                return None
            pairs_of[part] = pairs
    x, steep = np.array([pair for part in range(len(parts)) for pair in pairs_of[part]]).T
    x[0] = x[-1] = 0.0
    reach = 2 * np.diff(s) * np.minimum(steep[1:], steep[:-1])
    for k in range(1, len(x)):
        x[k] = min(x[k], x[k - 1] + reach[k - 1])
    for k in range(len(x) - 2, -1, -1):
        x[k] = min(x[k], x[k + 1] + reach[k])
    return sampled(space, curve, limits, stepped(s, np.sqrt(x)), "slowed")


def _bounds(space: PathSpace, curve: PathCurve, limits: ActuatorLimits, place: float) -> tuple[float, float] | None:
    """Return the largest ``x`` and the largest ``s̈`` at one ``s``; ``None`` if the limits allow no motion."""
    q, v, a = curve.moment(place)
    zero = np.zeros(space.model.nv)
    rest = limits.load(q, zero, zero)
    push = limits.load(q, zero, v) - rest
    rates = [limits.largest_rate(q, rest, d) for d in (limits.load(q, v, a) - rest, push, -push)]
    if not all(rates):
        return None
    bend, *drive = (_SHARE / 2 * rate for rate in rates if rate is not None)
    with np.errstate(divide="ignore"):
        fastest = float((space.problem.robot.velocity_limits / np.abs(v)).min())
    return min(bend, _SHARE * fastest**2, SAMPLE_TIME**-2), min(*drive, SAMPLE_TIME**-2)
