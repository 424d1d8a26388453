"""Controllers in scenarios over many seeds, and the targets that a better controller must meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from impact_posture.experiment.batch import Document, Progress, Store, run_batch
from impact_posture.experiment.jobs import Job, jsonable, parse_controller
from impact_posture.experiment.paper import PAPER, RECOMMENDED
from impact_posture.experiment.statistics import Row, row_of
from impact_posture.simulation.controller_factory import CONTROLLERS

SCHEMA, COMPARISON_SCHEMA = "impact-posture/reproduction/2", "impact-posture/comparison/2"
# The first two show what the posture that a term reaches does on its own, the third the metric without the feet.
HELD, FREE = ("robust:held", "walker:held"), "robust:free"
# Labels of controllers, by scenario.
Plan = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class Targets:
    """Targets of a better controller, for the means over the seeds.

    Attributes:
        reduction: The reduction of ``q_total_impact`` is at least that of the paper.
        recovery: So is that of ``q_total_recovery``, because a motion that only comes later is no reduction.
        peak_jump: The peak jump is not above nominal.
        peak_recovery: Nor is the peak until the recovery window ends.
        saturation: Nor is the time at a control limit within the impact windows.
        stops: No joint reached a position limit within an impact window.
        rested: The robot was at rest before every push.
    """

    reduction: bool
    recovery: bool
    peak_jump: bool
    peak_recovery: bool
    saturation: bool
    stops: bool
    rested: bool

    @property
    def met(self) -> bool:
        """Whether all are met."""
        return not self.missed

    @property
    def missed(self) -> tuple[str, ...]:
        """Names of the targets that are not met."""
        return tuple(name for name, value in vars(self).items() if not value)


def targets_of(row: Row) -> Targets | None:
    """Compare a row with its targets.  The nominal controller and a row without reduction have ``None``."""
    if row.reduction is None or row.recovery is None or row.controller == "nominal":
        return None
    paper = PAPER.get(row.scenario)
    least = 0.0 if paper is None else paper.reduction
    return Targets(
        reduction=row.reduction.mean >= least,
        recovery=row.recovery.mean >= least,
        peak_jump=row.change["peak_jump"].mean <= 0,
        peak_recovery=row.change["peak_recovery"].mean <= 0,
        # Numbers of ticks are whole, so a mean that only differs in the last digits is the same.
        saturation=row.change["saturation_inside"].mean <= 1e-9,
        stops=not row.stops,
        rested=row.rested,
    )


def best_of(rows: Sequence[Row]) -> Row | None:
    """Return the row with the largest reduction, of those that meet every target, or else of all.

    The smaller of the two reductions counts, within the window and until the recovery ends.
    """
    tried = [(row, targets) for row in rows if (targets := targets_of(row)) is not None and row.rested]
    met = [row for row, targets in tried if targets.met] or [row for row, _ in tried]
    return max(met, key=lambda row: min(r.mean if r else 0.0 for r in (row.reduction, row.recovery)), default=None)


def controllers_of(scenario: str, everything: bool) -> tuple[str, ...]:
    """Return the labels of the controllers of a reproduction, nominal first."""
    if everything:
        return (*CONTROLLERS, *HELD, *([FREE] if scenario.endswith("-push") else []))
    return tuple(dict.fromkeys(("nominal", "robust", RECOMMENDED[scenario])))


def jobs_of(plan: Plan, seeds: int) -> list[Job]:
    """Return all jobs of a plan, scenario by scenario, controller by controller, seed by seed."""
    found = []
    for scenario, labels in plan.items():
        for label in labels:
            name, mode, free = parse_controller(label)
            found += [Job(scenario, name, seed, mode, free) for seed in range(seeds)]
    return found


def gather(scenario: str, labels: Sequence[str], documents: Sequence[Document]) -> list[Row]:
    """Return the rows of a scenario from the documents of its jobs, in the order of :func:`jobs_of`."""
    count = len(documents) // len(labels)
    parts = {label: documents[k * count : (k + 1) * count] for k, label in enumerate(labels)}
    name = next((d["scenario"] for d in documents if d["runs"]), scenario)
    return [row_of(name, label, own, parts.get("nominal", [])) for label, own in parts.items()]


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Rows of all scenarios.

    Attributes:
        seeds: Number of seeds.
        rows: Rows, scenario by scenario, nominal first.
    """

    seeds: int
    rows: tuple[Row, ...]

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Names of the scenarios."""
        return tuple(dict.fromkeys(row.scenario for row in self.rows))

    def of(self, scenario: str) -> tuple[Row, ...]:
        """Return the rows of a scenario."""
        return tuple(row for row in self.rows if row.scenario == scenario)

    def row(self, scenario: str, controller: str) -> Row | None:
        """Return the row of a controller in a scenario."""
        return next((row for row in self.of(scenario) if row.controller == controller), None)

    def best(self, scenario: str) -> Row | None:
        """Return the best row of a scenario (:func:`best_of`)."""
        return best_of(self.of(scenario))

    def comparison(self) -> dict[str, Any]:
        """Return the content of ``comparison.json``, for one scenario."""
        head = {"schema": COMPARISON_SCHEMA, "scenario": self.rows[0].scenario, "seeds": list(range(self.seeds))}
        return head | {"rows": jsonable(self.rows)}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``reproduction.json``."""
        rows = []
        for row in self.rows:
            targets = targets_of(row)
            more = {
                "paper": PAPER.get(row.scenario),
                "targets": None if targets is None else {**vars(targets), "met": targets.met},
                "best": row is self.best(row.scenario),
            }
            rows.append(jsonable(row) | jsonable(more))
        return {"schema": SCHEMA, "seeds": list(range(self.seeds)), "rows": rows}


def reproduce(
    plan: Plan, *, seeds: int = 10, processes: int = 1, store: Store | None = None, progress: Progress | None = None
) -> Reproduction:
    """Run every controller in its scenarios with every seed.

    Args:
        plan: Controllers (:func:`~impact_posture.experiment.jobs.parse_controller`) by name or file of the scenario.
        seeds: Number of seeds, from 0.
        processes: Number of processes.
        store: Folder where finished runs are kept, with the time series of the first seed.
        progress: Callback with (done, all).

    Raises:
        ImpactPostureError: A scenario cannot be set up, there is no such controller, MuJoCo is not installed, or the
            store cannot be written.
    """
    jobs = jobs_of(plan, seeds)
    documents = run_batch(
        jobs,
        processes=processes,
        store=store,
        keep_series=lambda job: store is not None and job.seed == 0,
        progress=progress,
    )
    rows: list[Row] = []
    for scenario, labels in plan.items():
        count = len(labels) * seeds
        rows += gather(scenario, labels, documents[:count])
        documents = documents[count:]
    return Reproduction(seeds, tuple(rows))
