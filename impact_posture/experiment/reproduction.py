"""Run controllers in scenarios with many seeds, and compare them with Table I of Afifi et al. 2026."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from impact_posture.config.json_block import jsonable
from impact_posture.experiment.job_store import JobStore, Progress, run_batch
from impact_posture.experiment.jobs import Document, Job, parse_controller, software, worth_compiling
from impact_posture.experiment.seed_statistics import ControllerRow, Interval, row_of
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS

SCHEMA, COMPARISON_SCHEMA = "impact-posture/reproduction/3", "impact-posture/comparison/3"
# ``HELD`` controllers hold the reached posture and switch the impact-robust term off, so only the posture has an
# effect.  The ``FREE`` controller uses a metric that ignores the contacts at the feet.
HELD, FREE = ("robust:held", "walker:held"), "robust:free"
# Name or file of a scenario → labels of its controllers (:func:`parse_controller`).
Plan = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class PaperRow:
    """Row of Table I of Afifi et al. 2026.

    Attributes:
        nominal: ``q_total_impact`` of the nominal TSID controller.
        robust: ``q_total_impact`` of the impact-robust TSID controller.
        reduction: Reduction in the text of the paper, as a fraction of ``nominal``.
    """

    nominal: float
    robust: float
    reduction: float


# Rows of the paper.  Only the reductions can be compared with this package: the paper has other robots, gains and
# contact models, and its measurement windows end with the contact.
PAPER: dict[str, PaperRow] = {
    "aerial-vertical": PaperRow(10.4, 5.1, 0.51),
    "aerial-lateral": PaperRow(9.2, 5.5, 0.402),
    "solo8-push": PaperRow(0.411, 0.342, 0.168),
    "talos-push": PaperRow(0.305, 0.166, 0.456),
}
# Scenario → description of its values that were fitted to the numbers of the paper.
_AERIAL = (
    "nothing was fitted. The paper does not state the speed, the gains, the duration of the windows or the masses of "
    "the arm, and the integral grows with all of them"
)
_PUSHED = "the stiffness of the nominal controller was chosen so that its motion is near the paper's"
FITTED = {"aerial-vertical": _AERIAL, "aerial-lateral": _AERIAL, "solo8-push": _PUSHED, "talos-push": _PUSHED}

# Scenario → controller that meets its targets in most variations of the scenario (docs/reproduction.md), or else the
# controller that misses the targets least.
RECOMMENDED: dict[str, str] = {
    "aerial-vertical": "robust-flow",
    "aerial-lateral": "posture",
    "solo8-push": "stiff",
    "talos-push": "robust-flow",
}

# Target → function and text.  The function gets a row and the reduction in the paper, and returns true if the row
# misses the target.  The text says how the row misses the target.  The target ``recovery`` rejects controllers that
# only delay the motion.  Saturation times are multiples of a tick, so a difference below 1e-9 s is a rounding error.
_TARGETS: dict[str, tuple[Callable[[ControllerRow, float], bool], str]] = {
    "reduction": (lambda row, paper: _mean(row.reduction) < paper, "less than the paper's reduction"),
    "recovery": (lambda row, _: _mean(row.recovery) <= 0, "no less motion than nominal over the recovery"),
    "peak_jump": (lambda row, _: _change(row, "peak_jump") > 0, "a higher peak jump than nominal"),
    "peak_recovery": (lambda row, _: _change(row, "peak_recovery") > 0, "a higher peak than nominal in the recovery"),
    "saturation": (
        lambda row, _: _change(row, "saturation_inside") > 1e-9, "more saturation in the windows than nominal"
    ),
    "saturation_outside": (
        lambda row, _: _change(row, "saturation_outside") > 1e-9, "more saturation outside the windows than nominal"
    ),
    "stops": (lambda row, _: bool(row.stops), "a joint on its stop"),
    "rested": (lambda row, _: not row.rested, "not at rest before the push"),
}  # fmt: skip


def _change(row: ControllerRow, name: str) -> float:
    return row.change[name].mean


def _mean(value: Interval | None) -> float:
    return value.mean if value else 0.0


def missed_targets(row: ControllerRow) -> dict[str, str] | None:
    """Return the targets that a row misses: name → description of the miss.

    Return ``None`` for the nominal controller and for a row without reduction, because such rows have no targets.
    """
    if row.reduction is None or row.recovery is None or row.controller == "nominal":
        return None
    paper = PAPER[row.scenario].reduction if row.scenario in PAPER else 0.0
    return {name: instead for name, (misses, instead) in _TARGETS.items() if misses(row, paper)}


def best_of(rows: Sequence[ControllerRow]) -> ControllerRow | None:
    """Return the row with the largest reduction among the rows that meet every target.

    If no row meets every target, choose among all rows.  A row is ignored if the robot was not at rest before the
    push.  The compared reduction is the smaller value of ``reduction`` and ``recovery``.
    """
    missed = [(row, targets) for row in rows if (targets := missed_targets(row)) is not None and row.rested]
    candidates = [row for row, targets in missed if not targets] or [row for row, _ in missed]
    return max(candidates, key=lambda row: min(_mean(row.reduction), _mean(row.recovery)), default=None)


def controllers_of(scenario: str, everything: bool) -> tuple[str, ...]:
    """Return the labels of the main controllers, or of all controllers with ``everything``; nominal is first."""
    if everything:
        return (*CONTROLLERS, *HELD, *([FREE] if scenario.endswith("-push") else []))
    return tuple(dict.fromkeys(("nominal", "robust", "robust-flow", RECOMMENDED[scenario])))


def jobs_of(plan: Plan, seeds: int, compile: CompileMode = "auto") -> list[Job]:
    """Return all jobs of a plan, sorted by scenario, then by controller, then by seed."""
    jobs, compile = [], worth_compiling(compile, seeds)
    for scenario, labels in plan.items():
        for label in labels:
            name, mode, free = parse_controller(label)
            jobs += [Job(scenario, name, seed, mode, free, compile=compile) for seed in range(seeds)]
    return jobs


def gather(scenario: str, labels: Sequence[str], documents: Sequence[Document]) -> list[ControllerRow]:
    """Return one row for each controller in a scenario.  ``documents`` has the order of :func:`jobs_of`."""
    count = len(documents) // len(labels)
    parts = {label: documents[k * count : (k + 1) * count] for k, label in enumerate(labels)}
    name = next((d["scenario"] for d in documents if d["runs"]), scenario)
    return [row_of(name, label, part, parts.get("nominal", [])) for label, part in parts.items()]


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Results of all controllers in all scenarios.

    Attributes:
        rows: One row per scenario and controller, sorted by scenario, with nominal as the first controller.
        jobs: Jobs of all rows.
    """

    seeds: int
    rows: tuple[ControllerRow, ...]
    jobs: tuple[Job, ...] = ()

    @property
    def shown(self) -> list[Job]:
        """Jobs whose time series are stored (:attr:`Job.shown`)."""
        return [job for job in self.jobs if job.shown]

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Names of the scenarios."""
        return tuple(dict.fromkeys(row.scenario for row in self.rows))

    def of(self, scenario: str) -> tuple[ControllerRow, ...]:
        """Return the rows of a scenario."""
        return tuple(row for row in self.rows if row.scenario == scenario)

    def row(self, scenario: str, controller: str) -> ControllerRow | None:
        """Return the row of a controller in a scenario."""
        return next((row for row in self.of(scenario) if row.controller == controller), None)

    def best(self, scenario: str) -> ControllerRow | None:
        """Return the best row of a scenario (:func:`best_of`)."""
        return best_of(self.of(scenario))

    def comparison(self) -> dict[str, Any]:
        """Return the content of ``comparison.json``, for results of a single scenario."""
        head = {"schema": COMPARISON_SCHEMA, "scenario": self.rows[0].scenario, "seeds": list(range(self.seeds))}
        return head | {"versions": software(), "rows": jsonable(self.rows)}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``reproduction.json``."""
        rows = []
        for row in self.rows:
            missed, targets = missed_targets(row), None
            if missed is not None:
                targets = {name: name not in missed for name in _TARGETS} | {"met": not missed}
            more = {"paper": PAPER.get(row.scenario), "targets": targets, "best": row is self.best(row.scenario)}
            rows.append(jsonable(row) | jsonable(more))
        return {"schema": SCHEMA, "seeds": list(range(self.seeds)), "versions": software(), "rows": rows}


def reproduce(
    plan: Plan,
    *,
    seeds: int,
    processes: int = 1,
    store: JobStore | None = None,
    progress: Progress | None = None,
    compile: CompileMode = "auto",
) -> Reproduction:
    """Run the controllers of a plan in their scenarios, with the seeds 0 to ``seeds`` − 1.

    The store keeps the documents of finished jobs, and the time series of the first seed.  ``progress`` is called
    with the number of finished jobs and the number of all jobs.  ``compile`` decides whether controllers are
    compiled: ``always``, ``never``, or only if this saves time (``auto``).

    Raises:
        ImpactPostureError: A scenario cannot be set up, a controller does not exist, MuJoCo is not installed, or the
            store cannot be written.
    """
    jobs = jobs_of(plan, seeds, compile)
    documents = run_batch(jobs, processes=processes, store=store, progress=progress)
    rows: list[ControllerRow] = []
    for scenario, labels in plan.items():
        count = len(labels) * seeds
        rows += gather(scenario, labels, documents[:count])
        documents = documents[count:]
    return Reproduction(seeds, tuple(rows), tuple(jobs))
