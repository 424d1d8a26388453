"""Run every controller at a point of the envelope, and record the outcomes.  A failure is also an outcome."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from docs.studies.robustness.draws import COUNT, DWELL, PATIENCE, PAUSE, Draw, draw, prepare
from docs.studies.robustness.variations import RANGES
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError
from impact_posture.experiment.jobs import Document, Job, execute, lost_control, parse_controller
from impact_posture.experiment.reproduction import missed_targets
from impact_posture.experiment.seed_statistics import ControllerRow, row_of
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.loads.load_cases import load_cases
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import before
from impact_posture.simulation.offline_posture import SHARE, OfflinePosture, offline_posture, scenario_requirements
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario_objective import interpreted
from impact_posture.simulation.setup import Setup

SCHEMA = 3
NOMINAL = "nominal"
# Compared controllers.  The nominal controller must be the first.
COMPARED = (NOMINAL, "robust", "robust-flow", "posture", "stiff")
# Largest share of ticks at a limit, outside the impact windows, for which the nominal run of a random draw is
# admissible.
SATURATED = 0.05
# Largest number of random draws for a point.
ATTEMPTS = 40
# Keys of the document of a run that are not stored in a record.
_LEFT_OUT = ("windows", "versions", "runs")
# Maximum number of offline postures in the cache of this process.
_KEPT = 16
_OPTIMA: dict[str, OfflinePosture] = {}
_Play = Callable[[Job, ControllerFactory], tuple[tuple[Run, ...], Document]]


@dataclass(frozen=True)
class Record:
    """Results of all controllers at one point of the envelope.

    Attributes:
        draw: Point of the envelope, with its changed values.
        rejected: Reason why each earlier draw was rejected, or why this variation cannot be simulated.
        q: Start posture, shape (nq,); empty for a variation that cannot be simulated.
        documents: Documents of the runs, by label of the controller.  The entry ``offset`` is the distance of the
            center of mass from the line of the first impact, m.
    """

    draw: Draw
    rejected: tuple[str, ...] = ()
    q: tuple[float, ...] = ()
    documents: Mapping[str, Document] = field(default_factory=dict)

    def row(self, controller: str) -> ControllerRow:
        """Return the results of a controller relative to the nominal controller at this point."""
        own, nominal = self.documents[controller], self.documents[NOMINAL]
        return row_of(self.draw.scenario, controller, [own], [nominal])

    def missed(self, controller: str) -> dict[str, str]:
        """Return the targets that a controller misses at this point.  ``completed`` is also a target."""
        missed = missed_targets(self.row(controller))
        return {"completed": "no completed run"} if missed is None else missed

    def failure(self, controller: str) -> str:
        """Return the status of a run if the run did not complete; else an empty text."""
        status = str(self.documents[controller]["status"])
        return "" if status == "completed" else status

    def to_json(self) -> str:
        return json.dumps({"key": key(self.draw.scenario), **asdict(self)}, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Record | None:
        """Read a record from JSON text; return ``None`` if the study has changed since the record was written."""
        stored = json.loads(text)
        chosen = Draw(**stored["draw"])
        same = chosen.scenario in RANGES and stored["key"] == key(chosen.scenario)
        # The record of a variation whose number has changed is not valid.
        if not same or (chosen.name and draw(chosen.scenario, chosen.number, seed=chosen.seed) != chosen):
            return None
        return cls(chosen, tuple(stored["rejected"]), tuple(stored["q"]), stored["documents"])


def key(scenario: str) -> str:
    """Return the settings of the study.  A stored record with other settings is outdated."""
    ranges = tuple((r.name, r.low, r.high, r.scale) for r in RANGES[scenario])
    return repr((SCHEMA, SHARE, SATURATED, ranges, COUNT, DWELL, PATIENCE, PAUSE))


class NotAdmissible(Exception):
    """The nominal controller fails at a point, so that other controllers cannot be compared with it."""


def point(scenario: str, number: int, seed: int, known: Record | None = None, play: _Play = execute) -> Record:
    """Run the controllers that are missing in the record of a point, and return the record.

    Random draws are repeated until the nominal controller succeeds.  Variations are not repeated.

    Raises:
        NotAdmissible: No draw was admissible.
    """
    if known is not None and (known.documents or known.draw.name):
        return _complete(known, _factory(prepare(known.draw)), play)
    rejected: list[str] = []
    for attempt in range(ATTEMPTS):
        chosen = draw(scenario, number, attempt, seed)
        try:
            factory, nominal = _admit(chosen, play)
        except NotAdmissible as error:
            rejected.append(str(error))
            if chosen.name:
                return Record(chosen, tuple(rejected))
            continue
        q = tuple(float(x) for x in factory.setup.q)
        return _complete(Record(chosen, tuple(rejected), q, {NOMINAL: nominal}), factory, play)
    raise NotAdmissible(f"{scenario} {number}: none of {ATTEMPTS} draws is admissible: {sorted(set(rejected))}")


def _complete(record: Record, factory: ControllerFactory, play: _Play) -> Record:
    documents = dict(record.documents)
    for label in COMPARED:
        if label not in documents:
            documents[label] = _document(factory, record.draw, label, play)
    return replace(record, documents=documents)


def is_complete(record: Record | None) -> bool:
    """Return whether a record has every controller, or belongs to a variation that cannot be simulated."""
    return record is not None and (not record.documents or set(COMPARED) <= set(record.documents))


def is_held(setup: Setup, objective: WorstCaseObjective) -> bool:
    """Return whether the motors can hold the start of a scenario with :data:`SHARE` of their known limits."""
    holding = load_cases(objective, setup.q, scenario_requirements(setup, objective)).holding(setup.q)
    return holding is None or holding.feasible


def _factory(setup: Setup) -> ControllerFactory:
    """Return a factory of controllers for runs without pictures."""
    # Evaluate the gradient in Python, which takes less time than compiling it for every armature and mounting.
    factory = ControllerFactory(setup, gradient_of=interpreted, offline_of=_offline)
    # Skip the metric over time, which is used only for pictures.
    factory.metric = lambda q: math.nan
    return factory


def _offline(setup: Setup, objective: WorstCaseObjective, **options: Any) -> OfflinePosture:
    """Return the offline posture.  Points that differ only in gains, pushes or contact laws have the same posture."""
    demands = scenario_requirements(setup, objective, at_contact=options["at_contact"])
    impact = objective.contact, objective.metric, objective.kind, objective.supports, objective.compliance
    key = repr((setup.robot.source, setup.robot.data_sha256, setup.q.tobytes(), impact, demands, options))
    optimum = _OPTIMA[key] = _OPTIMA.pop(key, None) or offline_posture(setup, objective, **options)
    if len(_OPTIMA) > _KEPT:
        del _OPTIMA[next(iter(_OPTIMA))]
    return optimum


def _admit(chosen: Draw, play: _Play) -> tuple[ControllerFactory, Document]:
    try:
        setup = prepare(chosen)
    except ImpactPostureError as error:
        raise NotAdmissible(f"no start ({type(error).__name__})") from None
    factory = _factory(setup)
    if not is_held(setup, factory.objective()):
        raise NotAdmissible(f"the motors do not hold the start with {100 * SHARE:.0f} % of their limits")
    nominal = _document(factory, chosen, NOMINAL, play)
    if nominal["status"] != "completed":
        raise NotAdmissible(f"nominal {nominal['status']}")
    metrics = nominal["metrics"]
    if not metrics["rested"]:
        raise NotAdmissible("nominal did not come to rest")
    if not chosen.name and metrics["saturation_s"]["outside"] > SATURATED * nominal["duration"]:
        raise NotAdmissible(f"nominal is at a limit for over {100 * SATURATED:.0f} % of the time between the impacts")
    return factory, nominal


def _document(factory: ControllerFactory, chosen: Draw, label: str, play: _Play) -> Document:
    """Run a controller with the noise of seed 0.  If the run raises an error, the error becomes the outcome."""
    name, mode, free = parse_controller(label)
    job = Job(chosen.scenario, name, 0, mode, free, compile="auto")
    try:
        runs, document = play(job, factory)
    except (ImpactPostureError, np.linalg.LinAlgError) as error:
        return {**lost_control(job, error), "runs": [], "duration": 0.0, "offset": None}
    signs = [{"sign": part["sign"]} for part in document["runs"]]
    kept = {name: value for name, value in document.items() if name not in _LEFT_OUT}
    duration = max(float(run.series.t[-1]) for run in runs)
    return {**kept, "runs": signs, "duration": duration, "offset": _offset(factory, runs[0])}


def _offset(factory: ControllerFactory, run: Run) -> float | None:
    """Return the distance of the center of mass from the line of action of the first impact, m."""
    if not run.of("impact"):
        return None
    robot, contact = factory.setup.robot, factory.objective().contact
    q = run.series.q[before(run.series, run.of("impact")[0])]
    place = Numeric(robot.model).at(q).placement(point_on(robot, contact.frame, contact.offset)).translation
    arm = np.array(pin.centerOfMass(robot.model, robot.model.createData(), q)) - place
    n = factory.setup.scenario.normal
    return float(np.linalg.norm(arm - n * (n @ arm)))
