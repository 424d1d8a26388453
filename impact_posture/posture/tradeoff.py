"""The trade-off of objective against distance from the initial posture: its points, and where it has a knee."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from impact_posture.posture.certificate import Certificate

Vector = NDArray[np.float64]

# The part of the gain by which a knee lies above its part of the distance, at least.  A parabola, as every smooth
# optimum has one around it, reaches 1/4.
KNEE = 1 / 3


@dataclass(frozen=True, eq=False)
class TradePoint:
    """The best posture found within one distance.

    Attributes:
        within: The bound on the distance from the initial posture (rad mixed with m).
        distance: How far the posture is from it; less than ``within`` where going farther buys nothing.
        q: The posture, shape (nq,).
        objective: Its objective.
        H: Squared jump per squared impulse.
        G: Inverse effective mass, 1/kg.
        V: Squared jump per squared approach speed.
        S: The same when sticking, ``None`` where undefined.
        certificate: Of the problem with the bound; at distance zero its stationarity means nothing.
    """

    within: float
    distance: float
    q: Vector
    objective: float
    H: float
    G: float
    V: float
    S: float | None
    certificate: Certificate

    @property
    def certified(self) -> bool:
        """Whether the certificate holds; at distance zero, whether the posture satisfies the constraints."""
        found = self.certificate
        return replace(found, stationarity=0.0, complementarity=0.0).holds() if not self.within else found.holds()

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {
            "within": self.within,
            "distance": self.distance,
            "objective": self.objective,
            "H": self.H,
            "G": self.G,
            "V": self.V if np.isfinite(self.V) else None,
            "S": self.S,
            "certified": self.certified,
            "q": [float(v) for v in self.q],
        }


@dataclass(frozen=True, eq=False)
class TradeOff:
    """The curve.

    Attributes:
        points: By distance, the initial posture first.
        knee: Index of the point at the knee, if there is one (:func:`find_knee`).
        solves: Runs of the solver.
        solve_time_s: Wall time of them.
        build_time_s: Time to build the program.
        notes: What a user should know about the curve.
    """

    points: tuple[TradePoint, ...]
    knee: int | None
    solves: int
    solve_time_s: float
    build_time_s: float
    notes: tuple[str, ...]

    def to_list(self) -> list[dict[str, object]]:
        """``tradeoff`` in ``result.json``."""
        return [{**point.to_dict(), "knee": k == self.knee} for k, point in enumerate(self.points)]

    def arrays(self) -> dict[str, Vector]:
        """Entries of ``result.npz``: ``tradeoff_q`` (k, nq) and one number a point; NaN where S does not exist."""
        names = ("within", "distance", "objective", "H", "G", "V", "q", "certified")
        found = {f"tradeoff_{name}": np.array([getattr(p, name) for p in self.points]) for name in names}
        return found | {"tradeoff_S": np.array([np.nan if p.S is None else p.S for p in self.points])}


def find_knee(distances: Vector, objectives: Vector) -> int | None:
    """Index of the point whose share of the whole gain exceeds its share of the whole distance most.

    ``None`` if it does so by less than :data:`KNEE`, or if nothing is gained.
    """
    far, gain = distances[-1] - distances[0], objectives[0] - objectives[-1]
    if not (far > 0 and gain > 0):
        return None
    excess = (objectives[0] - objectives) / gain - (distances - distances[0]) / far
    best = int(np.argmax(excess))
    return best if excess[best] >= KNEE else None
