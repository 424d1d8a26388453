"""Means over seeds with intervals, and reductions against the nominal controller, seed by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

Document = dict[str, Any]
# What a table shows of each controller.
QUANTITIES = (
    "q_total_impact", "q_total_impact_base", "q_total_impact_joints", "q_total_dwell", "peak_jump", "peak_jump_max",
    "peak_force", "saturation_inside", "saturation_outside", "saturation_rotors", "relaxed_ticks", "failed_ticks",
    "slip",
)  # fmt: skip


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % confidence interval, Student's t.

    Attributes:
        mean: Of the samples.
        half_width: Of the interval; ``None`` from one sample.
        samples: How many.
    """

    mean: float
    half_width: float | None
    samples: int

    @staticmethod
    def of(values: Sequence[float]) -> Interval:
        """Of at least one sample."""
        n = len(values)
        mean = float(np.mean(values))
        if n < 2:
            return Interval(mean, None, n)
        return Interval(mean, float(stats.t.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n)), n)

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {"mean": self.mean, "half_width": self.half_width, "samples": self.samples}


@dataclass(frozen=True)
class Row:
    """A controller in a scenario, over all seeds.

    Attributes:
        scenario: Name.
        controller: Label.
        metrics: By name of :data:`QUANTITIES`; empty if every run failed.
        reduction: Of ``q_total_impact`` against nominal with the same seed, a share; ``None`` without one.
        change: Of the other quantities likewise, as differences to nominal.
        stops: Joints that reached a position limit within an impact window in any run.
        rested: Whether the robot was at rest before every push.
        failed: Errors of runs that came to no end.
        H: Just before the blows, mean.
        ratio: Measured jump over the rigid model's frictionless one, mean.
    """

    scenario: str
    controller: str
    metrics: Mapping[str, Interval]
    reduction: Interval | None
    change: Mapping[str, Interval]
    stops: tuple[str, ...]
    rested: bool
    failed: tuple[str, ...]
    H: float | None
    ratio: float | None

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {
            "scenario": self.scenario,
            "controller": self.controller,
            "metrics": {name: value.to_dict() for name, value in self.metrics.items()},
            "reduction": None if self.reduction is None else self.reduction.to_dict(),
            "change": {name: value.to_dict() for name, value in self.change.items()},
            "stops": list(self.stops),
            "rested": self.rested,
            "failed": list(self.failed),
            "H": self.H,
            "ratio": self.ratio,
        }


def value_of(document: Document, quantity: str) -> float:
    """A quantity of a run's document."""
    metrics = document["metrics"]
    if quantity.startswith("saturation_"):
        return float(metrics["saturation_s"][quantity.removeprefix("saturation_")])
    return float(metrics[quantity])


def row_of(scenario: str, controller: str, own: Sequence[Document], nominal: Sequence[Document]) -> Row:
    """Gather the runs of one controller.

    Args:
        scenario: Name.
        controller: Label.
        own: Its documents.
        nominal: Those of the nominal controller, paired by seed; empty: no comparison.
    """
    good = [d for d in own if "error" not in d]
    base = {d["seed"]: d for d in nominal if "error" not in d}
    pairs = [(d, base[d["seed"]]) for d in good if d["seed"] in base]
    reduction, change = None, {}
    if pairs:
        reduction = Interval.of([1 - value_of(d, "q_total_impact") / value_of(n, "q_total_impact") for d, n in pairs])
        change = {name: Interval.of([value_of(d, name) - value_of(n, name) for d, n in pairs]) for name in QUANTITIES}
    return Row(
        scenario=scenario,
        controller=controller,
        metrics={name: Interval.of([value_of(d, name) for d in good]) for name in QUANTITIES} if good else {},
        reduction=reduction,
        change=change,
        stops=tuple(dict.fromkeys(stop for d in good for stop in d["metrics"]["stops"])),
        rested=all(d["metrics"]["rested"] for d in good),
        failed=tuple(dict.fromkeys(d["error"] for d in own if "error" in d)),
        H=_mean([d["prediction"]["H"] for d in good]),
        ratio=_mean([d["prediction"]["ratio"] for d in good]),
    )


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
