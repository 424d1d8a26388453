"""Means over seeds with confidence intervals, and reductions against the nominal controller with the same seed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import stdtrit

from impact_posture.experiment.jobs import Document
from impact_posture.simulation.metrics import Metrics
from impact_posture.simulation.outcome import Outcome, gravest

# The metrics that have a mean and an interval.
QUANTITIES = tuple(f.name for f in fields(Metrics) if f.name not in ("stops", "contacts", "contacts_asked", "rested"))

# Fewest samples whose interval is shown.  For two samples, the quantile of Student's t is 12.7, so an interval says
# nothing.
FEWEST = 3
# Samples with a smaller relative half width differ only by rounding, because the scenario has no noise.
_SAME = 1e-12


@dataclass(frozen=True)
class Interval:
    """Mean with its 95 % confidence interval (Student's t).

    Attributes:
        half_width: Half width of the interval, ``None`` for one sample.
    """

    mean: float
    half_width: float | None
    samples: int

    @property
    def shown(self) -> float | None:
        """Half width that people see; ``None`` for fewer than :data:`FEWEST` samples or equal ones."""
        return None if self.samples < FEWEST or self.alike else self.half_width

    @property
    def alike(self) -> bool:
        """Whether several samples differ only by rounding."""
        return self.half_width is not None and self.half_width <= _SAME * abs(self.mean)

    @staticmethod
    def of(values: Sequence[float]) -> Interval:
        """Return the interval of at least one sample."""
        n = len(values)
        half_width = float(stdtrit(n - 1, 0.975) * np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else None
        return Interval(float(np.mean(values)), half_width, n)


def without_noise(intervals: Iterable[Interval]) -> bool:
    """Return whether there are intervals, and the samples of each are alike because the scenario has no noise."""
    alike = [interval.alike for interval in intervals]
    return bool(alike) and all(alike)


@dataclass(frozen=True)
class ControllerRow:
    """Results of a controller in a scenario, over all seeds.

    Attributes:
        controller: Label of the controller.
        status: ``completed`` if all runs completed, else the gravest status.
        completed: Number of runs that completed.
        failed: Reason why a run did not complete, one line each.
        metrics: Means of the completed runs, by name of :data:`QUANTITIES`.  Empty if no run completed.
        reduction: Reduction of ``q_total_impact`` against nominal with the same seed, a share.  ``None`` without
            nominal runs, or if a run of either controller did not complete.
        recovery: Reduction of ``q_total_recovery``.
        change: Differences of all quantities from nominal; empty where ``reduction`` is ``None``.
        stops: Joints that reached a position limit within an impact window of any run.
        rested: Whether the robot was at rest before every push.
        H: Mean of H just before the impacts.
        ratio: Mean of the measured jump over the jump of the rigid model with the friction of the surface.
        force: ``peak_force`` over the nominal value with the same seed; ``None`` where ``reduction`` is ``None``.
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


def value_of(document: Document, quantity: str) -> float:
    """Return a quantity of the document of a run."""
    metrics = document["metrics"]
    if quantity.startswith("saturation_"):
        return float(metrics["saturation_s"][quantity.removeprefix("saturation_")])
    return float(metrics[quantity])


def fate(document: Document) -> str:
    """Return the first event of the gravest kind in an incomplete run, with its time."""
    status = str(document["status"])
    first = next(event for event in document["events"] if event["status"] == status)
    sign = f" (push {first['sign']:+d})" if len(document["runs"]) > 1 else ""
    when = "" if first["time"] is None else f" at t = {first['time']:.2f} s"
    return f"{status}: {first['what']}{when}{sign}"


def row_of(
    scenario: str, controller: str, documents: Sequence[Document], nominal: Sequence[Document]
) -> ControllerRow:
    """Summarize the runs of a controller, compared to runs of the nominal controller with the same seeds, if any."""
    good = [d for d in documents if d["status"] == "completed"]
    base = {d["seed"]: d for d in nominal}
    pairs = [(d, base[d["seed"]]) for d in documents if d["seed"] in base]
    # If some runs failed, the seeds of the others are not a fair sample.
    fair = bool(pairs) and len(good) == len(documents) and all(n["status"] == "completed" for _, n in pairs)

    def paired(name: str, compare: Callable[[float, float], float]) -> Interval:
        return Interval.of([compare(value_of(d, name), value_of(n, name)) for d, n in pairs])

    def share(name: str) -> Interval | None:
        return paired(name, lambda mine, nominal: mine / nominal) if fair else None

    def reduction(name: str) -> Interval | None:
        ratio = share(name)
        return ratio and replace(ratio, mean=1 - ratio.mean)

    return ControllerRow(
        scenario=scenario,
        controller=controller,
        status=gravest(d["status"] for d in documents),
        runs=len(documents),
        completed=len(good),
        failed=tuple(f"seed {d['seed']}: {fate(d)}" for d in documents if d["status"] != "completed"),
        metrics={name: Interval.of([value_of(d, name) for d in good]) for name in QUANTITIES} if good else {},
        reduction=reduction("q_total_impact"),
        recovery=reduction("q_total_recovery"),
        change={name: paired(name, lambda mine, nominal: mine - nominal) for name in QUANTITIES} if fair else {},
        stops=tuple(dict.fromkeys(stop for d in good for stop in d["metrics"]["stops"])),
        rested=all(d["metrics"]["rested"] for d in good),
        H=_mean([d["prediction"]["H"] for d in good]),
        ratio=_mean([d["prediction"]["ratio"] for d in good]),
        force=share("peak_force"),
    )


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
