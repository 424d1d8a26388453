"""A run as a job, and the document with its results."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.errors import InputError
from impact_posture.posture.analysis.result_document import versions
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.simulation.controllers.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.metrics import Metrics, measure
from impact_posture.simulation.outcome import gravest, judge, links_behind
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import Run, run
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import set_up
from impact_posture.system.escape import file_name

Document = dict[str, Any]

SCHEMA = "impact-posture/simulation/4"
# Runs from which building pays: a humanoid's library takes about 6 s, and saves 4 s of each run.  The cache does not
# count, because a run would then depend on what ran before, and differ from another one by amplified rounding.
_PAYS = 2


@dataclass(frozen=True)
class Job:
    """A run, or both runs of a push.

    Attributes:
        scenario: Name or file of the scenario.
        controller: Name of the controller.
        seed: Seed of the sensor noise.
        mode: ``live`` or ``held``.
        free: Whether gradients and the offline optimum ignore the feet.
        gain: K instead of that of the scenario, 1/s².
        sign: The only sign of the push to run.
        compile: Whether its controller runs as machine code: ``auto`` where it can, always, or never.
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
        """Name of the controller and its variant, such as ``robust:held``."""
        return self.controller + (":held" if self.mode == "held" else "") + (":free" if self.free else "")

    @property
    def shown(self) -> bool:
        """Whether figures and reports show it, for which its time series are kept: of several seeds the first."""
        return self.seed == 0

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{file_name(self.scenario)}-{file_name(self.label.replace(':', '-'))}-{self.seed}"


def worth_compiling(compile: CompileMode, runs: int) -> CompileMode:
    """Return what :attr:`Job.compile` says where each controller has a number of runs.

    ``auto`` means machine code from two runs on.
    """
    return "never" if compile == "auto" and runs < _PAYS else compile


def parse_controller(text: str) -> tuple[str, Mode, bool]:
    """Parse ``robust``, ``robust:held``, ``robust:free`` or ``robust:held:free``.

    Raises:
        InputError: There is no such variant.
    """
    name, *words = text.strip().split(":")
    for word in words:
        if word not in ("held", "live", "free"):
            raise InputError(f"no variant '{word}'", where=f"controller '{text}'", hint="use held, live or free")
    return name, "held" if "held" in words else "live", "free" in words


@lru_cache(maxsize=8)
def controller_factory(scenario: str, free: bool = False) -> ControllerFactory:
    """Return a scenario that is ready to run, and keep it for the next job.

    Raises:
        ImpactPostureError: The scenario cannot be read or set up.
    """
    return ControllerFactory(set_up(read_scenario(scenario)), free)


def execute(job: Job, factory: ControllerFactory | None = None) -> tuple[tuple[Run, ...], Document]:
    """Run a job and return its runs and its document.

    Args:
        job: The job.
        factory: A variation of its scenario to run instead.

    Raises:
        ImpactPostureError: As :func:`impact_posture.simulation.run.run`, or the scenario cannot be set up.
    """
    if factory is None:
        factory = controller_factory(job.scenario, job.free)
    factory.compile = job.compile
    scenario = factory.setup.scenario
    if job.sign is not None and job.sign not in scenario.signs:
        raise InputError(f"is not pushed with sign {job.sign}", where=scenario.name, hint="leave `sign` out")
    found = run(factory, job.controller, seed=job.seed, mode=job.mode, gain=job.gain, only=job.sign)
    metrics = [measure(factory.setup, one) for one in found]
    parts = [_run_document(factory, one, measured) for one, measured in zip(found, metrics, strict=True)]
    status = gravest(part["status"] for part in parts)
    completed = status == "completed"
    offline = factory.offline(job.controller)
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
        "metrics": together(metrics).to_dict() if completed else None,
        "windows": [{**window, "sign": part["sign"]} for part in parts for window in part["windows"]],
        "prediction": _mean_prediction([p for part in parts for p in part["prediction"]]) if completed else None,
        "runs": parts,
        "offline": None if offline is None else offline.to_dict(),
        "path": factory.path.to_dict() if job.controller.removesuffix("-stiff") == "path" else None,
        "warnings": [*factory.warnings, *(links_behind(factory.setup, found) if completed else ())],
        "model_sha256": factory.setup.robot.model_sha256,
        "versions": software(),
    }
    return found, jsonable(document)


def software() -> dict[str, str]:
    """Return the versions of all software that a run depends on."""
    return versions() | {"mujoco": str(import_mujoco().__version__)}


def lost_control(job: Job, error: Exception) -> Document:
    """Return the document of a job that failed on its own, with the status ``control lost`` and without runs."""
    event = {"status": "control lost", "time": getattr(error, "time", None), "what": str(error), "sign": None}
    return {"schema": SCHEMA, "scenario": job.scenario, "controller": job.controller, "mode": job.mode,
            "free": job.free, "seed": job.seed, "status": "control lost", "events": [event], "metrics": None,
            "prediction": None, "windows": [], "runs": []}  # fmt: skip


def jsonable(content: object) -> Any:
    """Return JSON content: a dataclass becomes an object, an array a list, a number that is not finite ``None``."""
    return to_jsonable_python(content, inf_nan_mode="null", fallback=lambda array: array.tolist())


def together(metrics: list[Metrics]) -> Metrics:
    """Combine several runs: sums of ticks, the largest of what is a largest, all stops, and means of the others."""
    first = metrics[0]
    if len(metrics) == 1:
        return first
    values = {key: float(np.mean([getattr(m, key) for m in metrics])) for key in asdict(first) if key != "stops"}
    counts = ("relaxed_ticks", "failed_ticks", "contacts", "contacts_asked")
    ticks = {key: sum(getattr(m, key) for m in metrics) for key in counts}
    largest = {key: max(getattr(m, key) for m in metrics) for key in ("peak_jump_max", "peak_force")}
    stops = tuple(dict.fromkeys(stop for m in metrics for stop in m.stops))
    return Metrics(**{**values, **ticks, **largest, "stops": stops, "rested": all(m.rested for m in metrics)})


def _run_document(factory: ControllerFactory, one: Run, metrics: Metrics) -> Document:
    events = judge(factory.setup, one)
    content = {
        "sign": one.sign,
        "waited": one.waited,
        "status": gravest(event.status for event in events),
        "events": events,
        "ticks": one.series.t.size,
        "metrics": metrics.to_dict(),
        "windows": one.windows,
        "prediction": predict(factory.setup, factory.objective(), one),
    }
    return dict(jsonable(content))


def _mean_prediction(impacts: list[Document]) -> Document:
    """Return means over the impacts, and ``None`` where a value is undefined for one of them."""
    found: Document = {"impacts": len(impacts)}
    for key in ("H", "G", "V", "S", "approach", "frictionless", "sticking", "coulomb", "measured", "ratio"):
        values = [impact[key] for impact in impacts]
        found[key] = None if not values or None in values else float(np.mean(values))
    return found
