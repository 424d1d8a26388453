"""Statistics of the study of robustness: how often a controller helps, which targets it meets, and correlations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import spearmanr

from docs.studies.robustness.outcomes import NOMINAL, Record
from impact_posture.experiment.seed_statistics import value_of

# Name of a predictor of the jump → function that reads its value from the prediction in a document.  The impulse of
# a contact is not known before the contact, so the predictor H is √H without the impulse.
PREDICTORS: dict[str, Callable[[Mapping[str, float | None]], float | None]] = {
    "H": lambda p: None if p["H"] is None else math.sqrt(p["H"]),
    "V": lambda p: p["frictionless"],
    "S": lambda p: p["sticking"],
    "C": lambda p: p["coulomb"],
}


@dataclass(frozen=True)
class Summary:
    """Results of one controller at all points of a scenario.

    A controller that failed (error, lost contact, fall …) does not help.  In medians and quartiles, failed runs rank
    last.

    Attributes:
        count: Number of points.
        helps: Number of points with less motion in the impact windows than with the nominal controller.
        gentler: Number of points with a lower peak jump than with the nominal controller.
        kept: Number of points at which the controller meets every target.
        missed: For each target, number of points at which the controller misses this target.
        motion: Quartiles of the relative change of the motion in the impact windows; infinite for failed runs.
        recovery: Quartiles of the relative change of the motion during the recovery.
        jump: Median relative change of the peak jump.
        force: Median and largest peak force, each divided by the peak force with the nominal controller.
        saturation: Time at a limit over all runs that did not fail, s, inside and outside the windows.
        failures: For each status, number of points at which the controller failed with this status.
    """

    controller: str
    count: int
    helps: int
    gentler: int
    kept: int
    missed: Mapping[str, int]
    motion: tuple[float, ...]
    recovery: tuple[float, ...]
    jump: float
    force: tuple[float, float]
    saturation: tuple[float, float]
    failures: Mapping[str, int]


def tried(records: Sequence[Record]) -> list[Record]:
    """Return the records of points at which the controllers ran."""
    return [record for record in records if record.documents]


def change(record: Record, controller: str, metric: str = "q_total_impact") -> float:
    """Return the relative change of a metric from nominal: −0.3 is 30 % less, ``inf`` stands for a failure."""
    if record.failure(controller):
        return math.inf
    own, before = (value_of(record.documents[c], metric) for c in (controller, NOMINAL))
    return own / before - 1 if before > 0 else (math.inf if own > 0 else 0.0)


def summarize(records: Sequence[Record], controller: str) -> Summary:
    records = tried(records)
    fine = [record for record in records if not record.failure(controller)]
    motion, recovery, jumps = (
        [change(r, controller, metric) for r in records]
        for metric in ("q_total_impact", "q_total_recovery", "peak_jump")
    )
    force = [change(r, controller, "peak_force") + 1 for r in fine] or [math.nan]
    missed = Counter[str]() if controller == NOMINAL else Counter(t for r in records for t in r.missed(controller))
    kept = 0 if controller == NOMINAL else sum(not r.missed(controller) for r in records)
    inside, outside = (
        sum(value_of(r.documents[controller], f"saturation_{where}") for r in fine) for where in ("inside", "outside")
    )
    return Summary(
        controller,
        len(records),
        helps=sum(m < 0 for m in motion),
        gentler=sum(j < 0 for j in jumps),
        kept=kept,
        missed=missed,
        motion=quartiles(motion),
        recovery=quartiles(recovery),
        jump=quantile(jumps, 0.5),
        force=(quantile(force, 0.5), max(force)),
        saturation=(inside, outside),
        failures=Counter(failure for r in records if (failure := r.failure(controller))),
    )


def quartiles(values: Sequence[float]) -> tuple[float, ...]:
    """Return the lower quartile, the median and the upper quartile."""
    return tuple(quantile(values, p) for p in (0.25, 0.5, 0.75))


def quantile(values: Sequence[float], p: float) -> float:
    """Return a quantile by linear interpolation between neighbors.  The upper neighbor may be infinite."""
    ordered = sorted(values)
    place = p * (len(ordered) - 1)
    low = math.floor(place)
    share = place - low
    if share == 0 or ordered[low] == math.inf:
        return ordered[low]
    return ordered[low] + share * (ordered[low + 1] - ordered[low])


@dataclass(frozen=True)
class Split:
    """Part of the points: their number, how often a controller helped, and the median change of the motion."""

    count: int
    helps: int
    median: float


def split(records: Sequence[Record], controller: str, choose: Callable[[Record], bool]) -> tuple[Split, Split]:
    """Split records into chosen and other records, and return the results of both parts."""
    parts = [[change(r, controller) for r in records if choose(r) is wanted] for wanted in (True, False)]
    chosen, others = (Split(len(m), sum(x < 0 for x in m), quantile(m, 0.5) if m else math.nan) for m in parts)
    return chosen, others


def predicted(record: Record, controller: str, name: str) -> float | None:
    """Return the prediction of the jump by H, V, S or C, or ``None`` if it is unknown."""
    prediction = record.documents[controller]["prediction"]
    return None if prediction is None or not prediction["impacts"] else PREDICTORS[name](prediction)


def ranks_of_jumps(records: Sequence[Record], names: Sequence[str]) -> dict[str, float]:
    """Return Spearman's correlation of the measured jumps with each predictor, and the number of runs as ``n``.

    Only runs for which every predictor is known are included.
    """
    runs = [(r, c) for r in tried(records) for c in r.documents if not r.failure(c)]
    rows = [[value_of(r.documents[c], "peak_jump"), *(predicted(r, c, name) for name in names)] for r, c in runs]
    known = np.array([row for row in rows if None not in row], dtype=float).reshape(-1, 1 + len(names))
    correlations = {"n": float(len(known))}
    for k, name in enumerate(names, 1):
        pair = known[:, [0, k]]
        constant = len(pair) < 3 or np.ptp(pair, axis=0).min() == 0
        correlations[name] = math.nan if constant else float(spearmanr(pair).statistic)
    return correlations


def fall(record: Record, controller: str, name: str) -> float | None:
    """Return how much smaller a predictor (logarithm of the ratio) or the offset (m) is than for nominal."""
    if name == "offset":
        before, after = (record.documents[c]["offset"] for c in (NOMINAL, controller))
        return None if before is None or after is None else float(before - after)
    before, after = (predicted(record, c, name) for c in (NOMINAL, controller))
    return math.log(before / after) if before and after else None


def agreement(records: Sequence[Record], names: Sequence[str], of: str, metric: str) -> tuple[int, int]:
    """Return in how many runs metric and predictor changed in the same direction, and the number of all runs."""
    same = [
        (fallen > 0) == (change(r, c, metric) < 0)
        for r in records
        for c in names
        if not r.failure(c) and (fallen := fall(r, c, of)) is not None
    ]
    return sum(same), len(same)


def rank(records: Sequence[Record], controller: str, of: Callable[[Record], float | None]) -> float:
    """Return Spearman's correlation of a value with the *reduction* of the motion, without failed runs."""
    pairs = [(of(r), -change(r, controller)) for r in records if not r.failure(controller)]
    known = np.array([pair for pair in pairs if pair[0] is not None], dtype=float).reshape(-1, 2)
    if len(known) < 3 or np.ptp(known, axis=0).min() == 0:
        return math.nan
    return float(spearmanr(known).statistic)


def worst(records: Sequence[Record], controller: str) -> Record | None:
    """Return the record with the largest change of the motion, without failed runs."""
    fine = [r for r in records if not r.failure(controller)]
    return max(fine, key=lambda r: change(r, controller), default=None)


def misled(records: Sequence[Record], controller: str) -> Record | None:
    """Return the record with the largest decrease of H among the records with an increased jump."""
    fine = [r for r in records if not r.failure(controller) and change(r, controller, "peak_jump") > 0]
    fallen = {k: fall(r, controller, "H") or 0.0 for k, r in enumerate(fine)}
    most = max(fallen, key=lambda k: fallen[k], default=None)
    return None if most is None or fallen[most] <= 0 else fine[most]
