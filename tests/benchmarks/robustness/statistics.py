"""How often a controller helps, and what goes with it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import spearmanr

from tests.benchmarks.robustness.outcomes import NOMINAL, Record


@dataclass(frozen=True)
class Summary:
    """Of one controller in all configurations of a scenario.

    A controller that failed (raised, missed a contact, fell …) helped in nothing; in medians and quartiles it counts
    as worse than any that did not.
    """

    controller: str
    count: int
    helps: int  # with less motion in the impact windows (q_total_impact) than nominal
    gentler: int  # with a lower peak jump
    both: int
    freer: int  # with no more seconds at a control limit in the impact windows than nominal
    stops: int  # with a joint on a position limit in the windows that was not there at the start
    quartiles: tuple[float, ...]  # of the relative change of the motion: lower, median, upper; inf: failed
    jump: float  # median relative change of the peak jump
    saturation: tuple[float, ...]  # seconds at a limit of those that did not fail: in the windows, and else
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
    fine = [record for record in records if not record.outcomes[controller].failure]
    motion, jumps = ([change(r, controller, metric) for r in records] for metric in ("q_total_impact", "peak_jump"))
    inside = [[r.outcomes[c].metrics["saturation_inside"] for r in fine] for c in (controller, NOMINAL)]
    outside = [r.outcomes[controller].metrics["saturation_outside"] for r in fine]
    return Summary(
        controller,
        len(records),
        helps=sum(m < 0 for m in motion),
        gentler=sum(j < 0 for j in jumps),
        both=sum(m < 0 and j < 0 for m, j in zip(motion, jumps, strict=True)),
        freer=sum(own <= nominal for own, nominal in zip(*inside, strict=True)),
        stops=sum(bool(r.outcomes[controller].stops) for r in fine),
        quartiles=tuple(quantile(motion, p) for p in (0.25, 0.5, 0.75)),
        jump=quantile(jumps, 0.5),
        saturation=(sum(inside[0]), sum(outside)),
        failures=Counter(failure for r in records if (failure := r.outcomes[controller].failure)),
    )


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
    parts = [[change(r, controller) for r in records if choose(r) is wanted] for wanted in (True, False)]
    chosen, others = (Split(len(m), sum(x < 0 for x in m), quantile(m, 0.5) if m else math.nan) for m in parts)
    return chosen, others


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
    known = np.array([pair for pair in pairs if pair[0] is not None], dtype=float).reshape(-1, 2)
    if len(known) < 3 or np.ptp(known, axis=0).min() == 0:
        return math.nan
    return float(spearmanr(known).statistic)


def worst(records: Sequence[Record], controller: str) -> Record | None:
    """With the largest change of the motion among those that did not fail."""
    fine = [r for r in records if not r.outcomes[controller].failure]
    return max(fine, key=lambda r: change(r, controller), default=None)


def misled(records: Sequence[Record], controller: str) -> Record | None:
    """Where H fell most though the jump rose."""
    fine = [r for r in records if not r.outcomes[controller].failure and change(r, controller, "peak_jump") > 0]
    fallen = {k: fall(r, controller, "H") or 0.0 for k, r in enumerate(fine)}
    most = max(fallen, key=lambda k: fallen[k], default=None)
    return None if most is None or fallen[most] <= 0 else fine[most]
