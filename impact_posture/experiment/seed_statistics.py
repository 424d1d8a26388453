"""Means over seeds with confidence intervals, and reductions relative to nominal runs with the same seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.special import stdtrit

from impact_posture.experiment.jobs import Document
from impact_posture.impact.evaluation.impact_effect import ImpactLoad, WorstJoint, worst_joint
from impact_posture.posture.analysis.verdict_changes import changes, outcome_of
from impact_posture.simulation.metrics import Metrics
from impact_posture.simulation.outcome import Outcome, gravest

# Metrics for which a mean and a confidence interval are computed.
_OTHERS = ("stops", "contacts", "contacts_asked", "rested", "joint")
QUANTITIES = (*(f.name for f in fields(Metrics) if f.name not in _OTHERS), "joint_velocity", "joint_share")

# Confidence level of the intervals.
CONFIDENCE = 0.95
# An interval is shown only for at least this number of samples.  For two samples, the quantile of Student's t is
# 12.7, so the interval is too wide to be useful.
FEWEST = 3
# If the half width divided by the mean is smaller than this, the samples differ only by rounding.
_SAME = 1e-12


@dataclass(frozen=True)
class Interval:
    """Mean with its confidence interval (Student's t) of the level :data:`CONFIDENCE`.

    Attributes:
        mean: Mean of the samples.
        half_width: Half width of the interval; ``None`` for one sample.
    """

    mean: float
    half_width: float | None
    samples: int

    @property
    def shown(self) -> float | None:
        """Half width for tables and figures; ``None`` for fewer than :data:`FEWEST` samples or equal samples."""
        return None if self.samples < FEWEST or self.alike else self.half_width

    @property
    def alike(self) -> bool:
        """True if there are several samples that differ only by rounding."""
        return self.half_width is not None and self.half_width <= _SAME * abs(self.mean)

    @staticmethod
    def of(values: Sequence[float]) -> Interval:
        """Return the mean and interval of one or more samples."""
        n = len(values)
        if n == 1:
            return Interval(float(values[0]), None, 1)
        half_width = stdtrit(n - 1, (1 + CONFIDENCE) / 2) * np.std(values, ddof=1) / np.sqrt(n)
        return Interval(float(np.mean(values)), float(half_width), n)


def statistic(seeds: int, intervals: Sequence[Interval]) -> str:
    """Describe the numbers of a table in words: means over ``seeds`` seeds, with their ``intervals``."""
    if seeds == 1:
        return "one seed, so there are no intervals"
    means = f"means of {seeds} seeds"
    if intervals and all(interval.alike for interval in intervals):
        return f"{means}, all alike, because the scenario has no noise"
    shown = f"± half of the {100 * CONFIDENCE:g} % confidence interval"
    return f"{means} {shown}" if seeds >= FEWEST else f"{means} (intervals from {FEWEST} seeds on)"


@dataclass(frozen=True)
class ControllerRow:
    """Results of a controller in a scenario, over all seeds.

    Attributes:
        controller: Label of the controller.
        status: ``completed`` if all runs completed, otherwise the worst status of a run.
        completed: Number of runs that completed.
        failed: Seed and reason of each run that did not complete, one line per run.
        metrics: Name in :data:`QUANTITIES` → mean over the completed runs; empty if no run completed.  Quantities
            that do not exist for this robot are left out.
        reduction: Reduction of ``q_total_impact`` relative to nominal with the same seed, as a fraction.  ``None`` if
            there are no nominal runs, or if a run of either controller did not complete.
        recovery: Like ``reduction``, but for ``q_total_recovery``.
        change: Name in :data:`QUANTITIES` → difference from nominal; empty if ``reduction`` is ``None``.
        stops: Joints that reached a position limit within an impact window of any run.
        rested: True if the robot was at rest before every push.
        H: Mean of H just before the impacts.
        ratio: Mean of the measured velocity jump divided by the jump that the rigid-body model with friction
            predicts.
        force: ``peak_force`` divided by its nominal value with the same seed; ``None`` if ``reduction`` is ``None``.
        joint: The joint with the largest share of its velocity limit in any completed run.
        approach: Mean of the approach speed, m/s; ``None`` for pushes.
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
    force: Interval | None
    joint: WorstJoint | None = None
    approach: float | None = None


def headline(row: Document, nominal: Document) -> str:
    """Return one line on a controller: the outcome, and motion, peak jump and peak force relative to nominal.

    The outcome follows from the effects on base, joints and contact, by the rule of the verdict of ``optimize``
    (:func:`~impact_posture.posture.analysis.verdict_changes.outcome_of`).  Both arguments are rows of
    ``comparison.json``, with a reduction in ``row``.
    """
    less = row["reduction"]["mean"]
    parts = [f"{row['controller']} moves {abs(less):.0%} {'less' if less > 0 else 'more'}"]
    change = row["change"]["peak_jump"]["mean"] / nominal["metrics"]["peak_jump"]["mean"]
    costs = [f"peak jump {change:+.0%}"]
    # In a push scenario, the peak force is the force of the push, so it does not change.
    if abs(row["force"]["mean"] - 1) > _SAME:
        costs.append(f"peak force × {row['force']['mean']:.2g}")
    parts.append(", ".join(costs))
    # Results of older versions of this package do not contain the impulse.
    if "impulse" in row["change"]:
        parts.append(_outcome(row, nominal))
    return "; ".join(parts)


def _outcome(row: Document, nominal: Document) -> str:
    """Return the outcome in words.  A change smaller than the half width of its interval counts as zero."""
    intervals = {name: Interval(**interval) for name, interval in row["change"].items()}
    doubtful = {name for name, each in intervals.items() if each.shown is not None and abs(each.mean) <= each.shown}
    before = {name: float(interval["mean"]) for name, interval in nominal["metrics"].items()}
    after = {name: before[name] + (0.0 if name in doubtful else each.mean) for name, each in intervals.items()}
    first, last = (_load(values, nominal["joint"]) for values in (before, after))
    outcome = outcome_of(changes(first, last, row["approach"] or 0.0))
    compared = {field.name for field in fields(ImpactLoad)} | {"joint_velocity", "joint_share"}
    return f"the impact itself is {outcome}{' beyond the intervals' if doubtful & compared else ''}"


def _load(means: Mapping[str, float], joint: Document | None) -> ImpactLoad:
    """Return the effects on base, joints and contact, given the mean of each of :data:`QUANTITIES`.

    ``joint`` describes the joint with the largest load.
    """
    worst = joint and WorstJoint(joint["name"], means["joint_velocity"], joint["unit"], means.get("joint_share"))
    base = means.get("base_linear"), means.get("base_angular")
    return ImpactLoad(*base, worst or None, means["impulse"], means["peak_force"], means["peak_jump"])


def value_of(document: Document, quantity: str) -> Any:
    """Return the value of a metric in the document of a job, or ``None`` if the robot has no such quantity."""
    metrics = document["metrics"]
    for key, table in (("saturation_", metrics["saturation_s"]), ("joint_", metrics["joint"] or {})):
        if quantity.startswith(key):
            return table.get(quantity.removeprefix(key))
    return metrics[quantity]


def fate(document: Document) -> str:
    """Describe why a job did not complete: the first event that caused its status, with the time of this event."""
    status = str(document["status"])
    first = next(event for event in document["events"] if event["status"] == status)
    sign = f" (push {first['sign']:+d})" if len(document["runs"]) > 1 else ""
    when = "" if first["time"] is None else f" at t = {first['time']:.2f} s"
    return f"{status}: {first['what']}{when}{sign}"


def row_of(
    scenario: str, controller: str, documents: Sequence[Document], nominal: Sequence[Document]
) -> ControllerRow:
    """Summarize the runs of a controller, and compare them with ``nominal`` runs that have the same seeds."""
    good = [d for d in documents if d["status"] == "completed"]
    base = {d["seed"]: d for d in nominal}
    pairs = [(d, base[d["seed"]]) for d in documents if d["seed"] in base]
    # If a run failed, compare no runs, because the completed runs alone are not a representative sample.
    fair = bool(pairs) and len(good) == len(documents) and all(n["status"] == "completed" for _, n in pairs)

    def paired(name: str, compare: Callable[[float, float], float]) -> Interval:
        return Interval.of([compare(value_of(d, name), value_of(n, name)) for d, n in pairs])

    def share(name: str) -> Interval | None:
        return paired(name, lambda mine, nominal: mine / nominal) if fair else None

    def reduction(name: str) -> Interval | None:
        ratio = share(name)
        return ratio and replace(ratio, mean=1 - ratio.mean)

    compared = [*good, *(n for _, n in pairs if n["status"] == "completed")]
    known = [name for name in QUANTITIES if all(value_of(d, name) is not None for d in compared)]
    joint = worst_joint([WorstJoint(**d["metrics"]["joint"]) for d in good if d["metrics"]["joint"]])
    pushed = any(d["prediction"]["coulomb"] is None for d in good)
    return ControllerRow(
        scenario=scenario,
        controller=controller,
        status=gravest(d["status"] for d in documents),
        runs=len(documents),
        completed=len(good),
        failed=tuple(f"seed {d['seed']}: {fate(d)}" for d in documents if d["status"] != "completed"),
        metrics={name: Interval.of([value_of(d, name) for d in good]) for name in known} if good else {},
        reduction=reduction("q_total_impact"),
        recovery=reduction("q_total_recovery"),
        change={name: paired(name, lambda mine, nominal: mine - nominal) for name in known} if fair else {},
        stops=tuple(dict.fromkeys(stop for d in good for stop in d["metrics"]["stops"])),
        rested=all(d["metrics"]["rested"] for d in good),
        H=_mean([d["prediction"]["H"] for d in good]),
        ratio=_mean([d["prediction"]["ratio"] for d in good]),
        force=share("peak_force"),
        joint=joint,
        approach=None if pushed else _mean([d["prediction"]["approach"] for d in good]),
    )


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
