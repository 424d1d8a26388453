"""Jobs of an experiment, and the JSON documents with their results."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from impact_posture.config.json_block import jsonable
from impact_posture.errors import InputError
from impact_posture.impact.evaluation.impact_effect import mean_load
from impact_posture.posture.analysis.result_document import versions
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.simulation.controllers.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.metrics import Metrics, measure
from impact_posture.simulation.outcome import doubts, gravest, judge, links_behind
from impact_posture.simulation.prediction import Prediction, predict
from impact_posture.simulation.run import Run, run
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.seed_variation import set_up_with
from impact_posture.system.escape import file_name
from impact_posture.system.optional_package import import_mujoco

Document = dict[str, Any]

SCHEMA = "impact-posture/simulation/4"
# Compiling the controller saves time from this number of runs on.  For a humanoid, compiling takes about 6 s and
# saves 4 s in each run.  A library in the cache does not change this number, because the rounding errors of a run
# must not depend on earlier runs.
_PAYS = 2


@dataclass(frozen=True)
class Job:
    """Simulation of one controller in one scenario with one seed.  A push or throw has one run for each sign.

    Attributes:
        scenario: Name or file of the scenario.
        seed: Seed of the sensor noise and of the changes in ``[spread]`` of the scenario.
        mode: ``live``, or ``held`` to hold the reached posture (:func:`impact_posture.simulation.run.run`).
        free: If true, the impact model ignores the contacts at the feet.
        gain: K of the impact-robust term, 1/s²; ``None`` for the value in the scenario.
        sign: Sign of the push or throw; ``None`` for every sign of the scenario.
        compile: Whether the controller is compiled: ``always``, ``never``, or ``auto`` (if a compiler is available).
    """

    scenario: str
    controller: str
    seed: int = 0
    mode: Mode = "live"
    free: bool = False
    gain: float | None = None
    sign: int | None = None
    compile: CompileMode = "never"

    @property
    def label(self) -> str:
        """Name of the controller with its variants, such as ``robust:held``."""
        return self.controller + (":held" if self.mode == "held" else "") + (":free" if self.free else "")

    @property
    def shown(self) -> bool:
        """Whether figures and reports show this job; true for seed 0.  Time series are stored only for shown jobs."""
        return self.seed == 0

    @property
    def name(self) -> str:
        """Name of the files of this job, without extension."""
        return f"{file_name(self.scenario)}-{file_name(self.label.replace(':', '-'))}-{self.seed}"


def worth_compiling(compile: CompileMode, runs: int) -> CompileMode:
    """Return :attr:`Job.compile` for ``runs`` runs of each controller.  For one run, ``auto`` means ``never``."""
    return "never" if compile == "auto" and runs < _PAYS else compile


def parse_controller(text: str) -> tuple[str, Mode, bool]:
    """Parse ``robust``, ``robust:held``, ``robust:free`` or ``robust:held:free``.

    Raises:
        InputError: A variant is unknown.
    """
    name, *variants = text.strip().split(":")
    for variant in variants:
        if variant not in ("held", "live", "free"):
            raise InputError(f"no variant '{variant}'", where=f"controller '{text}'", hint="use held, live or free")
    return name, "held" if "held" in variants else "live", "free" in variants


@lru_cache(maxsize=32)
def controller_factory(scenario: str, free: bool = False, seed: int = 0) -> ControllerFactory:
    """Return the controller factory of a scenario with the changes of a seed.

    Jobs with the same arguments share a cached factory.

    Raises:
        ImpactPostureError: The scenario cannot be read or set up.
    """
    return ControllerFactory(set_up_with(read_scenario(scenario), seed), free)


def execute(job: Job, factory: ControllerFactory | None = None) -> tuple[tuple[Run, ...], Document]:
    """Run a job; return the runs of the job and its JSON document.

    By default, ``factory`` is :func:`controller_factory` of the scenario.

    Raises:
        ImpactPostureError: The scenario cannot be set up, or :func:`impact_posture.simulation.run.run` fails.
    """
    if factory is None:
        factory = controller_factory(job.scenario, job.free, job.seed)
    factory.compile = job.compile
    scenario = factory.setup.scenario
    if job.sign is not None and job.sign not in scenario.signs:
        raise InputError(f"has no push in the direction {job.sign:+d}", where=scenario.name, hint="omit `sign`")
    runs = run(factory, job.controller, seed=job.seed, mode=job.mode, gain=job.gain, only=job.sign)
    metrics = [measure(factory.setup, record) for record in runs]
    predictions = [predict(factory.setup, factory.objective(), record) for record in runs]
    parts = [_run_document(factory, *each) for each in zip(runs, metrics, predictions, strict=True)]
    status = gravest(part["status"] for part in parts)
    completed = status == "completed"
    offline = factory.offline(job.controller)
    prediction = _mean_prediction([impact for each in predictions for impact in each]) if completed else None
    warnings = [*factory.setup.warnings, *factory.warnings]
    if prediction is not None:
        warnings += [*links_behind(factory.setup, runs), *doubts(factory.setup, runs, metrics, prediction["ratio"])]
    document = {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "source": scenario.source,
        "controller": job.controller,
        "mode": job.mode,
        "free": job.free,
        "gain": scenario.control.robust.gain if job.gain is None else job.gain,
        "seed": job.seed,
        "language": "C" if factory.in_c else "Python",
        "status": status,
        "events": [{**event, "sign": part["sign"]} for part in parts for event in part["events"]],
        "metrics": combined(metrics).to_dict() if completed else None,
        "windows": [{**window, "sign": part["sign"]} for part in parts for window in part["windows"]],
        "prediction": prediction,
        "runs": parts,
        "offline": None if offline is None else offline.to_dict(),
        "path": None if (path := factory.path_of(job.controller)) is None else path.to_dict(),
        "warnings": warnings,
        "model_sha256": factory.setup.robot.model_sha256,
        "versions": software(),
    }
    return runs, jsonable(document)


def software() -> dict[str, str]:
    """Return the versions of all software that affects a run."""
    return versions() | {"mujoco": str(import_mujoco().__version__)}


def lost_control(job: Job, error: Exception) -> Document:
    """Return the document of a failed job, with the status ``control lost`` and no runs."""
    event = {"status": "control lost", "time": getattr(error, "time", None), "what": str(error), "sign": None}
    return {"schema": SCHEMA, "scenario": job.scenario, "controller": job.controller, "mode": job.mode,
            "free": job.free, "seed": job.seed, "status": "control lost", "events": [event], "metrics": None,
            "prediction": None, "windows": [], "runs": []}  # fmt: skip


def combined(metrics: list[Metrics]) -> Metrics:
    """Combine the metrics of several runs.

    Counts are added, and ``stops`` contains the joints of all runs.  ``peak_jump_max`` and ``peak_force`` are the
    largest values of all runs, and ``joint`` is the worst joint of all runs.  ``rested`` is true if it is true for
    all runs.  All other metrics are means.
    """
    first, load = metrics[0], mean_load([m.load for m in metrics])
    if len(metrics) == 1:
        return first
    effect = {key: getattr(load, key) for key in ("base_linear", "base_angular", "joint")}
    averaged = {*asdict(first)} - {*effect, "stops"}
    values = {key: float(np.mean([getattr(m, key) for m in metrics])) for key in averaged}
    counts = ("relaxed_ticks", "failed_ticks", "contacts", "contacts_asked")
    ticks = {key: sum(getattr(m, key) for m in metrics) for key in counts}
    largest = {key: max(getattr(m, key) for m in metrics) for key in ("peak_jump_max", "peak_force")}
    stops = tuple(dict.fromkeys(stop for m in metrics for stop in m.stops))
    rested = all(m.rested for m in metrics)
    return Metrics(**{**values, **ticks, **largest, **effect, "stops": stops, "rested": rested})


def _run_document(
    factory: ControllerFactory, record: Run, metrics: Metrics, predictions: tuple[Prediction, ...]
) -> Document:
    events = judge(factory.setup, record)
    content = {
        "sign": record.sign,
        "waited": record.waited,
        "status": gravest(event.status for event in events),
        "events": events,
        "ticks": record.series.t.size,
        "metrics": metrics.to_dict(),
        "windows": record.windows,
        "prediction": predictions,
    }
    return dict(jsonable(content))


def _mean_prediction(impacts: list[Prediction]) -> Document:
    """Return the mean of each predicted quantity over the impacts; ``None`` if it is undefined for an impact.

    The loads are combined by :func:`~impact_posture.impact.evaluation.impact_effect.mean_load`.
    """
    means: Document = {"impacts": len(impacts)}
    numbers = ("approach", "restitution", "frictionless", "sticking", "coulomb", "measured", "ratio")
    for key in ("H", "G", "V", "S", *numbers):
        values = [getattr(impact, key) for impact in impacts]
        means[key] = None if not values or None in values else float(np.mean(values))
    for key in ("predicted_impact", "measured_impact"):
        means[key] = mean_load([getattr(impact, key) for impact in impacts]) if impacts else None
    return means
