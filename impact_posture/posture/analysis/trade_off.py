"""Points and knee of the trade-off between objective and distance from the initial posture, or peak force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.config.problem_settings import Against
from impact_posture.posture.program.certificate import Certificate
from impact_posture.system.arrays import Array

# A point is a knee only if its fraction of the largest gain exceeds its fraction of the largest distance by this
# value.  For a parabola, which every smooth optimum resembles, the excess is at most 1/4, so a parabola has no knee.
KNEE = 1 / 3


@dataclass(frozen=True, eq=False)
class TradePoint(JsonBlock):
    """The best posture under a bound on distance or force, with H, G, V and S of its impact.

    Attributes:
        within: The bound on the distance from the initial posture (rad mixed with m), or on the peak force (N).
        distance: Distance or force of the posture; it is below ``within`` if a larger distance or force does not
            improve the objective.
        q: Posture, shape (nq,).
        certificate: Optimality certificate of the problem with this bound.  Stationarity has no meaning at the first
            point, because only one posture satisfies its bound.
        first: Whether this is the first point, the only posture at the least distance or force.
    """

    within: float
    distance: float
    q: Array
    objective: float
    H: float
    G: float
    V: float
    S: float | None
    certificate: Certificate
    first: bool = False
    derived = ("certified",)

    @property
    def certified(self) -> bool:
        """Whether the posture is certified; at the first point, whether it satisfies the constraints."""
        return self.certificate.feasible if self.first else self.certificate.holds()

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return {key: value for key, value in super().to_dict().items() if key not in ("certificate", "first")}


@dataclass(frozen=True, eq=False)
class TradeOff:
    """The best objective under each bound on ``against``: the distance from the initial posture, or the peak force.

    ``points`` are the points of the curve, in the order of increasing distance or force.  ``knee`` is the index of
    the point at the knee (:func:`find_knee`); ``None`` if there is no knee.  ``solves`` is the number of times that
    the solver ran.
    """

    points: tuple[TradePoint, ...]
    knee: int | None
    solves: int
    solve_time_s: float
    build_time_s: float
    notes: tuple[str, ...]
    against: Against = "distance"

    def to_list(self) -> list[dict[str, object]]:
        """Return the ``tradeoff`` block of ``result.json``."""
        return [{**point.to_dict(), "knee": k == self.knee} for k, point in enumerate(self.points)]

    def arrays(self) -> dict[str, Array]:
        """Return the trade-off arrays of ``result.npz``, one row or entry per point; an undefined S is NaN."""
        names = ("within", "distance", "objective", "H", "G", "V", "q", "certified")
        arrays = {f"tradeoff_{name}": np.array([getattr(p, name) for p in self.points]) for name in names}
        return arrays | {"tradeoff_S": np.array([np.nan if p.S is None else p.S for p in self.points])}


def find_knee(distances: Array, objectives: Array) -> int | None:
    """Return the index of the point with the largest difference: fraction of the gain minus fraction of the distance.

    The gain is the decrease of the objective along the curve.  Return ``None`` if this difference is below
    :data:`KNEE`, or if the objective does not decrease.
    """
    far, gain = distances[-1] - distances[0], objectives[0] - objectives[-1]
    if not (far > 0 and gain > 0):
        return None
    excess = (objectives[0] - objectives) / gain - (distances - distances[0]) / far
    best = int(np.argmax(excess))
    return best if excess[best] >= KNEE else None
