"""The paper's table: scenarios, controllers and seeds, and the targets that a result must meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from impact_posture.experiment.batch import Document, Progress, Store, run_batch
from impact_posture.experiment.jobs import Job, parse_controller
from impact_posture.experiment.paper import PAPER, RECOMMENDED
from impact_posture.experiment.statistics import Row, row_of
from impact_posture.simulation.controller_factory import CONTROLLERS

SCHEMA, COMPARISON_SCHEMA = "impact-posture/reproduction/2", "impact-posture/comparison/2"
# The posture that a term reaches apart from what it does while the impact lasts; and the metric without the feet.
HELD, FREE = ("robust:held", "walker:held"), "robust:free"


@dataclass(frozen=True)
class Targets:
    """What a better controller must do, by the means over the seeds.

    Attributes:
        reduction: Of ``q_total_impact``, at least the paper's.
        recovery: Of ``q_total_recovery`` likewise: what is stored in the window and given back later is no reduction.
        peak_jump: Not above nominal.
        peak_recovery: Nor is the peak until the recovery window ends.
        saturation: Time at a control limit within the impact windows not above nominal.
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
        """All of them."""
        return all(self.__dict__.values())

    @property
    def missed(self) -> tuple[str, ...]:
        """Names of those that are not met."""
        return tuple(name for name, value in self.__dict__.items() if not value)


def targets_of(row: Row) -> Targets | None:
    """Hold a row against its targets; ``None`` for the nominal controller, and without a reduction."""
    if row.reduction is None or row.recovery is None or row.controller == "nominal":
        return None
    paper = PAPER.get(row.scenario)
    least = 0.0 if paper is None else paper.reduction
    return Targets(
        reduction=row.reduction.mean >= least,
        recovery=row.recovery.mean >= least,
        peak_jump=row.change["peak_jump"].mean <= 0,
        peak_recovery=row.change["peak_recovery"].mean <= 0,
        # Ticks are whole: a mean that differs in the last digits is the same.
        saturation=row.change["saturation_inside"].mean <= 1e-9,
        stops=not row.stops,
        rested=row.rested,
    )


def best_of(rows: Sequence[Row]) -> Row | None:
    """Of a scenario's rows the one that moves least among those that meet every target, else among all.

    What counts is the smaller of its two reductions, within the window and until the recovery ends.
    """
    tried = [(row, targets) for row in rows if (targets := targets_of(row)) is not None and row.rested]
    met = [row for row, targets in tried if targets.met] or [row for row, _ in tried]
    return max(met, key=lambda row: min(r.mean if r else 0.0 for r in (row.reduction, row.recovery)), default=None)


def controllers_of(scenario: str, everything: bool) -> tuple[str, ...]:
    """Labels of the controllers of a reproduction: nominal first."""
    pushed = scenario.endswith("-push")
    if everything:
        return (*CONTROLLERS, *HELD, FREE) if pushed else (*CONTROLLERS, *HELD)
    return tuple(dict.fromkeys(("nominal", "robust", RECOMMENDED[scenario])))


def jobs_of(scenario: str, controllers: Sequence[str], seeds: int) -> list[Job]:
    """All runs of some controllers in a scenario."""
    found = []
    for text in controllers:
        name, mode, free = parse_controller(text)
        found += [Job(scenario, name, seed, mode, free) for seed in range(seeds)]
    return found


def gather(scenario: str, controllers: Sequence[str], documents: Sequence[Document]) -> list[Row]:
    """Rows of a scenario out of the documents of :func:`jobs_of`, in their order."""
    count = len(documents) // len(controllers)
    parts = {c: documents[k * count : (k + 1) * count] for k, c in enumerate(controllers)}
    name = next((d["scenario"] for d in documents if d["runs"]), scenario)
    return [row_of(name, c, own, parts.get("nominal", [])) for c, own in parts.items()]


def compare(
    scenario: str,
    controllers: Sequence[str],
    *,
    seeds: int = 3,
    processes: int = 1,
    store: Store | None = None,
    progress: Progress | None = None,
) -> list[Row]:
    """Run controllers through a scenario, each with every seed; time series of the first seed are kept in the store.

    Args:
        scenario: Name or file.
        controllers: Labels (:func:`~impact_posture.experiment.jobs.parse_controller`).
        seeds: How many, from 0.
        processes: How many runs at once.
        store: Where finished runs are kept.
        progress: Told of (done, all).

    Raises:
        ImpactPostureError: A scenario that cannot be set up, no such controller.
    """
    jobs = jobs_of(scenario, controllers, seeds)
    documents = run_batch(
        jobs,
        processes=processes,
        store=store,
        keep_series=lambda job: store is not None and job.seed == 0,
        progress=progress,
    )
    return gather(scenario, controllers, documents)


def comparison_document(rows: Sequence[Row], seeds: int) -> dict[str, Any]:
    """Content of ``comparison.json``."""
    return {
        "schema": COMPARISON_SCHEMA,
        "scenario": rows[0].scenario,
        "seeds": list(range(seeds)),
        "rows": [row.to_dict() for row in rows],
    }


@dataclass(frozen=True, eq=False)
class Reproduction:
    """All rows.

    Attributes:
        seeds: How many a controller.
        rows: By scenario, nominal first.
    """

    seeds: int
    rows: tuple[Row, ...]

    @property
    def scenarios(self) -> tuple[str, ...]:
        """In their order."""
        return tuple(dict.fromkeys(row.scenario for row in self.rows))

    def of(self, scenario: str) -> tuple[Row, ...]:
        """Rows of a scenario."""
        return tuple(row for row in self.rows if row.scenario == scenario)

    def best(self, scenario: str) -> Row | None:
        """See :func:`best_of`."""
        return best_of(self.of(scenario))

    def to_dict(self) -> dict[str, Any]:
        """JSON content."""
        rows = []
        for row in self.rows:
            targets, paper = targets_of(row), PAPER.get(row.scenario)
            rows.append(
                row.to_dict()
                | {
                    "paper": None if paper is None else paper.to_dict(),
                    "targets": None if targets is None else {**targets.__dict__, "met": targets.met},
                    "best": row is self.best(row.scenario),
                }
            )
        return {"schema": SCHEMA, "seeds": list(range(self.seeds)), "rows": rows}


def reproduce(
    scenarios: Sequence[str],
    *,
    seeds: int = 10,
    everything: bool = False,
    processes: int = 1,
    store: Store | None = None,
    progress: Progress | None = None,
) -> Reproduction:
    """Run every scenario with its controllers; time series of the first seed are kept in the store.

    Raises:
        ImpactPostureError: MuJoCo is not installed, or a store that cannot be written.
    """
    plan = [(s, controllers_of(s, everything)) for s in scenarios]
    jobs = [job for scenario, controllers in plan for job in jobs_of(scenario, controllers, seeds)]
    documents = run_batch(
        jobs,
        processes=processes,
        store=store,
        keep_series=lambda job: store is not None and job.seed == 0,
        progress=progress,
    )
    rows: list[Row] = []
    for scenario, controllers in plan:
        count = len(controllers) * seeds
        own, documents = documents[:count], documents[count:]
        rows += gather(scenario, controllers, own)
    return Reproduction(seeds, tuple(rows))
