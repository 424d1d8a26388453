"""How often a controller helps, and what goes with it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from tests.benchmarks.robustness.outcomes import NOMINAL, Outcome, Record


@dataclass(frozen=True)
class Summary:
    """Of one controller in all configurations of a scenario.

    A controller that failed (raised, missed a contact, fell …) helped in nothing; in medians and quartiles it counts
    as worse than any that did not.

    Attributes:
        controller: Which.
        count: Configurations.
        helps: With less motion in the impact windows (``q_total_impact``) than nominal.
        gentler: With a lower peak jump.
        both: With both.
        freer: Seconds at a control limit in the impact windows no more than nominal.
        stops: With a joint on a position limit in the windows that was not there at the start.
        quartiles: Of the relative change of the motion: lower quartile, median, upper quartile; ``inf``: failed.
        jump: Median relative change of the peak jump.
        saturation: Seconds at a limit, all configurations that did not fail: in the impact windows, and else.
        failures: How many of each kind.
    """

    controller: str
    count: int
    helps: int
    gentler: int
    both: int
    freer: int
    stops: int
    quartiles: tuple[float, float, float]
    jump: float
    saturation: tuple[float, float]
    failures: Mapping[str, int]


def change(record: Record, controller: str, metric: str = "q_total_impact") -> float:
    """A metric against nominal: −0.3 is 30 % less; ``inf`` of a controller that failed."""
    own = record.outcomes[controller]
    if own.failure:
        return math.inf
    before = record.outcomes[NOMINAL].metrics[metric]
    return own.metrics[metric] / before - 1 if before > 0 else (math.inf if own.metrics[metric] > 0 else 0.0)


def summarize(records: Sequence[Record], controller: str) -> Summary:
    """Count and rank."""
    outcomes = [record.outcomes[controller] for record in records]
    fine = [o for o in outcomes if not o.failure]
    motion = [change(record, controller) for record in records]
    jumps = [change(record, controller, "peak_jump") for record in records]
    freer = [
        not r.outcomes[controller].failure
        and r.outcomes[controller].metrics["saturation_inside"] <= r.outcomes[NOMINAL].metrics["saturation_inside"]
        for r in records
    ]
    return Summary(
        controller,
        len(records),
        helps=sum(m < 0 for m in motion),
        gentler=sum(j < 0 for j in jumps),
        both=sum(m < 0 and j < 0 for m, j in zip(motion, jumps, strict=True)),
        freer=sum(freer),
        stops=sum(bool(o.stops) for o in fine),
        quartiles=(quantile(motion, 0.25), quantile(motion, 0.5), quantile(motion, 0.75)),
        jump=quantile(jumps, 0.5),
        saturation=_sums(fine),
        failures=Counter(o.failure for o in outcomes if o.failure),
    )


def _sums(fine: Sequence[Outcome]) -> tuple[float, float]:
    inside, outside = (sum(o.metrics[f"saturation_{key}"] for o in fine) for key in ("inside", "outside"))
    return inside, outside


def quantile(values: Sequence[float], p: float) -> float:
    """Linear between neighbors, of which the upper may be infinite."""
    ordered = sorted(values)
    place = p * (len(ordered) - 1)
    low = math.floor(place)
    share = place - low
    if share == 0 or ordered[low] == math.inf:
        return ordered[low]
    return ordered[low] + share * (ordered[low + 1] - ordered[low])


@dataclass(frozen=True)
class Split:
    """How often a controller helped among some configurations, and how much: median change of the motion."""

    count: int
    helps: int
    median: float


def split(records: Sequence[Record], controller: str, choose: Callable[[Record], bool]) -> tuple[Split, Split]:
    """Those that are chosen, and the others."""
    parts = []
    for wanted in (True, False):
        motion = [change(r, controller) for r in records if choose(r) is wanted]
        parts.append(Split(len(motion), sum(m < 0 for m in motion), quantile(motion, 0.5) if motion else math.nan))
    return parts[0], parts[1]


def fall(record: Record, controller: str, name: str) -> float | None:
    """How much lower H, V (as ln of the ratio) or the offset (m) is before the impact than nominal's."""
    before, after = (getattr(record.outcomes[c], name) for c in (NOMINAL, controller))
    if before is None or after is None:
        return None
    return float(before - after) if name == "offset" else math.log(before / after)


def agreement(records: Sequence[Record], names: Sequence[str], of: str, metric: str) -> tuple[int, int]:
    """In how many runs that did not fail a metric fell where H or V did, and rose where it rose; and of how many."""
    same = [
        (fallen > 0) == (change(r, c, metric) < 0)
        for r in records
        for c in names
        if not r.outcomes[c].failure and (fallen := fall(r, c, of)) is not None
    ]
    return sum(same), len(same)


def rank(records: Sequence[Record], controller: str, of: Callable[[Record], float | None]) -> float:
    """Spearman's correlation of a number with the *reduction* of the motion, among those that did not fail."""
    pairs = [(of(r), -change(r, controller)) for r in records if not r.outcomes[controller].failure]
    known = np.array([(a, b) for a, b in pairs if a is not None], dtype=float).reshape(-1, 2)
    if len(known) < 3 or np.ptp(known, axis=0).min() == 0:
        return math.nan
    return float(np.corrcoef(rankdata(known[:, 0]), rankdata(known[:, 1]))[0, 1])


def worst(records: Sequence[Record], controller: str) -> Record | None:
    """With the largest change of the motion among those that did not fail."""
    fine = [r for r in records if not r.outcomes[controller].failure]
    return max(fine, key=lambda r: change(r, controller), default=None)


def misled(records: Sequence[Record], controller: str) -> Record | None:
    """Where H fell most though the jump rose."""
    risen = [
        (fallen, r)
        for r in records
        if not r.outcomes[controller].failure
        and change(r, controller, "peak_jump") > 0
        and (fallen := fall(r, controller, "H")) is not None
        and fallen > 0
    ]
    return max(risen, key=lambda pair: pair[0])[1] if risen else None
