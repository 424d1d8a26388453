"""What becomes of one configuration: every controller runs through it, and what goes wrong is an outcome too."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError, SimulationDiverged
from impact_posture.impact.contact import point_on
from impact_posture.simulation.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import Metrics, before, measure
from impact_posture.simulation.offline import SHARE, is_held
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import Run, run
from impact_posture.simulation.scenario import RepeatedContacts, Setup
from impact_posture.simulation.scenario_objective import interpreted, scenario_objective
from tests.benchmarks.robustness.draws import COUNT, DWELL, PATIENCE, PAUSE, RANGES, Draw, draw, prepare

SCHEMA = 1
NOMINAL = "nominal"
# The robust term that is off, with the posture that it reached, when the push comes.
HELD = "robust:held"
AERIAL = (NOMINAL, "robust", "robust-speed", "posture")
PUSHED = (NOMINAL, "robust", HELD, "posture")
# Share of the motors' limits with which the start must be held; share of a nominal run's ticks outside the windows
# that may be at a limit.
SATURATED = 0.05
# Draws of a configuration before it is given up.
ATTEMPTS = 40
# Tilt (rad) from which on a robot that flies has lost itself; share of its height below which one that stands has
# fallen: only its feet meet the ground, the rest falls through.
_TILT, _HEIGHT = math.pi / 4, 0.3
_RUNS = Callable[[ControllerFactory, str], tuple[Run, ...]]


@dataclass(frozen=True)
class Outcome:
    """Of one controller in one configuration."""

    failure: str = ""  # what went wrong; empty: nothing
    metrics: Mapping[str, float] = field(default_factory=dict)  # as simulation.metrics.Metrics; empty: there are none
    stops: tuple[str, ...] = ()
    H: float | None = None  # before the impacts, mean
    V: float | None = None  # the same
    offset: float | None = None  # of the center of mass from the line of the first impact, m


@dataclass(frozen=True)
class Record:
    """Of one configuration: the draw, why each before it was rejected, the start, and outcomes by controller."""

    draw: Draw
    rejected: tuple[str, ...]
    q: tuple[float, ...]
    outcomes: Mapping[str, Outcome]

    def to_json(self) -> str:
        """The record as text."""
        return json.dumps({"key": key(self.draw.scenario), **asdict(self)}, indent=1)

    @classmethod
    def from_json(cls, text: str) -> Record | None:
        """Back again; ``None`` where the study has changed since."""
        found = json.loads(text)
        chosen = Draw(**found["draw"])
        if chosen.scenario not in RANGES or found["key"] != key(chosen.scenario):
            return None
        outcomes = {name: Outcome(**{**o, "stops": tuple(o["stops"])}) for name, o in found["outcomes"].items()}
        return cls(chosen, tuple(found["rejected"]), tuple(found["q"]), outcomes)


def controllers(scenario: str) -> tuple[str, ...]:
    """Those that run in a scenario."""
    return AERIAL if scenario.startswith("aerial") else PUSHED


def key(scenario: str) -> str:
    """What a kept record must have in common with this code."""
    ranges = tuple((r.name, r.low, r.high, r.scale) for r in RANGES[scenario])
    return repr((SCHEMA, controllers(scenario), SHARE, SATURATED, ranges, COUNT, DWELL, PATIENCE, PAUSE))


class NotAdmissible(Exception):
    """A draw that makes no experiment: the nominal controller itself does not get through it."""


def play(factory: ControllerFactory, controller: str) -> tuple[Run, ...]:
    """One run, noise of seed 0."""
    name, _, mode = controller.partition(":")
    return run(factory, name, mode="held" if mode else "live")


def configuration(scenario: str, number: int, seed: int, runs: _RUNS = play) -> Record:
    """Draw until the nominal controller gets through, then let all controllers.

    Raises:
        NotAdmissible: No draw was.
    """
    rejected: list[str] = []
    for attempt in range(ATTEMPTS):
        chosen = draw(scenario, number, attempt, seed)
        try:
            factory, nominal = _admit(chosen, runs)
        except NotAdmissible as error:
            rejected.append(str(error))
            continue
        outcomes = {NOMINAL: nominal}
        for name in controllers(scenario)[1:]:
            outcomes[name] = outcome(factory, name, runs)
        return Record(chosen, tuple(rejected), tuple(float(x) for x in factory.setup.q), outcomes)
    raise NotAdmissible(f"{scenario} {number}: none of {ATTEMPTS} draws is admissible: {sorted(set(rejected))}")


def _admit(chosen: Draw, runs: _RUNS) -> tuple[ControllerFactory, Outcome]:
    try:
        setup = prepare(chosen)
    except ImpactPostureError as error:
        raise NotAdmissible(f"no start ({type(error).__name__})") from None
    if not is_held(setup, scenario_objective(setup)):
        raise NotAdmissible(f"the motors do not hold the start with {100 * SHARE:.0f} % of their limits")
    factory = ControllerFactory(setup, gradient_of=interpreted)
    nominal = outcome(factory, NOMINAL, runs)
    if nominal.failure:
        raise NotAdmissible(f"nominal {nominal.failure}")
    if nominal.metrics["saturation_outside"] > SATURATED * nominal.metrics["duration"]:
        raise NotAdmissible(f"nominal is at a limit for over {100 * SATURATED:.0f} % of the time between the impacts")
    return factory, nominal


def outcome(factory: ControllerFactory, controller: str, runs: _RUNS = play) -> Outcome:
    """Let a controller run; what it raises is what becomes of it."""
    try:
        [found] = runs(factory, controller)
    except SimulationDiverged:
        return Outcome("diverged")
    except (ImpactPostureError, np.linalg.LinAlgError) as error:
        return Outcome(f"raised {type(error).__name__}")
    setup, metrics = factory.setup, measure(factory.setup, found)
    impacts = predict(setup, factory.objective(), found)
    numbers = {name: float(value) for name, value in asdict(metrics).items() if isinstance(value, int | float)}
    return Outcome(
        _failure(setup, found, metrics),
        {**numbers, "duration": float(found.series.t[-1])},
        metrics.stops,
        float(np.mean([b.H for b in impacts])) if impacts else None,
        float(np.mean([b.V for b in impacts])) if impacts else None,
        _offset(factory, found),
    )


def _failure(setup: Setup, found: Run, metrics: Metrics) -> str:
    task, series = setup.scenario.task, found.series
    if isinstance(task, RepeatedContacts):
        upright = np.array([pin.Quaternion(q[3:7]).matrix()[2, 2] for q in series.q[::10]])
        if (upright < math.cos(_TILT)).any():
            return "tipped over"
        return "missed a contact" if metrics.contacts < task.count else ""
    # The ground is at height zero.
    if (series.q[:, 2] < _HEIGHT * series.q[0, 2]).any():
        return "fell"
    return "" if metrics.rested else "did not come to rest"


def _offset(factory: ControllerFactory, found: Run) -> float | None:
    """Distance of the center of mass from the line along which the first impact acts."""
    robot, contact = factory.setup.robot, factory.objective().contact
    q = found.series.q[before(found.series, found.of("impact")[0])]
    place = Numeric(robot.model).at(q).placement(point_on(robot, contact.frame, contact.offset)).translation
    arm = np.array(pin.centerOfMass(robot.model, robot.model.createData(), q)) - place
    n = factory.setup.scenario.normal
    return float(np.linalg.norm(arm - n * (n @ arm)))
