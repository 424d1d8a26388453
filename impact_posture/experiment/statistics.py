"""Means over seeds with intervals, and reductions against the nominal controller, seed by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from impact_posture.simulation.outcome import Outcome, gravest

Document = dict[str, Any]
# What a table shows of each controller.
QUANTITIES = (
    "q_total_impact", "q_total_impact_base", "q_total_impact_joints", "q_total_dwell", "q_total_recovery",
    "peak_jump", "peak_jump_max", "peak_recovery", "peak_force", "saturation_inside", "saturation_outside",
    "saturation_rotors", "relaxed_ticks", "failed_ticks", "slip",
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
        status: The gravest of its runs'; ``completed`` if all are.
        runs: How many there are.
        completed: How many of them completed.
        failed: What became of the others, a line each.
        metrics: Of the completed runs, by name of :data:`QUANTITIES`; empty if there is none.
        reduction: Of ``q_total_impact`` against nominal with the same seed, a share; ``None`` without one, or where
            not every run of both completed.
        recovery: The same of ``q_total_recovery``.
        change: Of the other quantities likewise, as differences to nominal.
        stops: Joints that reached a position limit within an impact window in any run.
        rested: Whether the robot was at rest before every push.
        H: Just before the impacts, mean.
        ratio: Measured jump over the rigid model's frictionless one, mean.
    """

    scenario: str
    controller: str
    status: Outcome
    runs: int
    completed: int
    failed: tuple[str, ...]
    metrics: Mapping[str, Interval]
    reduction: Interval | None
    recovery: Interval | None
    change: Mapping[str, Interval]
    stops: tuple[str, ...]
    rested: bool
    H: float | None
    ratio: float | None

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        return {
            "scenario": self.scenario,
            "controller": self.controller,
            "status": self.status,
            "runs": self.runs,
            "completed": self.completed,
            "failed": list(self.failed),
            "metrics": {name: value.to_dict() for name, value in self.metrics.items()},
            "reduction": None if self.reduction is None else self.reduction.to_dict(),
            "recovery": None if self.recovery is None else self.recovery.to_dict(),
            "change": {name: value.to_dict() for name, value in self.change.items()},
            "stops": list(self.stops),
            "rested": self.rested,
            "H": self.H,
            "ratio": self.ratio,
        }


def value_of(document: Document, quantity: str) -> float:
    """A quantity of a run's document."""
    metrics = document["metrics"]
    if quantity.startswith("saturation_"):
        return float(metrics["saturation_s"][quantity.removeprefix("saturation_")])
    return float(metrics[quantity])


def fate(document: Document) -> str:
    """What became of a run that did not complete, and when, in words: the first event of the gravest kind."""
    status = str(document["status"])
    first = next(event for event in document["events"] if event["status"] == status)
    sign = f" (push {first['sign']:+d})" if len(document["runs"]) > 1 else ""
    when = "" if first["time"] is None else f" at t = {first['time']:.2f} s"
    return f"{status}: {first['what']}{when}{sign}"


def row_of(scenario: str, controller: str, own: Sequence[Document], nominal: Sequence[Document]) -> Row:
    """Gather the runs of one controller.

    Args:
        scenario: Name.
        controller: Label.
        own: Its documents.
        nominal: Those of the nominal controller, paired by seed; empty: no comparison.
    """
    good = [d for d in own if d["status"] == "completed"]
    base = {d["seed"]: d for d in nominal}
    pairs = [(d, base[d["seed"]]) for d in own if d["seed"] in base]
    reduction, recovery, change = None, None, {}
    # The seeds that are left where others fell are no fair sample.
    if pairs and len(good) == len(own) and all(n["status"] == "completed" for _, n in pairs):
        reduction, recovery = (
            Interval.of([1 - value_of(d, name) / value_of(n, name) for d, n in pairs])
            for name in ("q_total_impact", "q_total_recovery")
        )
        change = {name: Interval.of([value_of(d, name) - value_of(n, name) for d, n in pairs]) for name in QUANTITIES}
    return Row(
        scenario=scenario,
        controller=controller,
        status=gravest(d["status"] for d in own),
        runs=len(own),
        completed=len(good),
        failed=tuple(f"seed {d['seed']}: {fate(d)}" for d in own if d["status"] != "completed"),
        metrics={name: Interval.of([value_of(d, name) for d in good]) for name in QUANTITIES} if good else {},
        reduction=reduction,
        recovery=recovery,
        change=change,
        stops=tuple(dict.fromkeys(stop for d in good for stop in d["metrics"]["stops"])),
        rested=all(d["metrics"]["rested"] for d in good),
        H=_mean([d["prediction"]["H"] for d in good]),
        ratio=_mean([d["prediction"]["ratio"] for d in good]),
    )


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
