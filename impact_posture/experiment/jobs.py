"""One run as a job: what is asked, and the document that answers it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from impact_posture.errors import InputError
from impact_posture.escape import file_name
from impact_posture.posture.result import versions
from impact_posture.simulation.controller_factory import ControllerFactory, Mode
from impact_posture.simulation.metrics import Metrics, measure
from impact_posture.simulation.outcome import gravest, judge
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import Run, run
from impact_posture.simulation.scenario import set_up
from impact_posture.simulation.scenario_file import read_scenario

SCHEMA = "impact-posture/simulation/3"


@dataclass(frozen=True)
class Job:
    """One run; both signs of a push are one.

    Attributes:
        scenario: Name or file.
        controller: Name.
        seed: Of the sensors' noise.
        mode: ``live`` or ``held``.
        free: Gradients and offline optimum without the feet.
        gain: K instead of the scenario's, 1/s².
        sign: That sign of the push alone.
    """

    scenario: str
    controller: str
    seed: int = 0
    mode: Mode = "live"
    free: bool = False
    gain: float | None = None
    sign: int | None = None

    @property
    def label(self) -> str:
        """Controller, with what is not usual about it."""
        return self.controller + (":held" if self.mode == "held" else "") + (":free" if self.free else "")

    @property
    def name(self) -> str:
        """For files."""
        return f"{file_name(self.scenario)}-{file_name(self.label.replace(':', '-'))}-{self.seed}"


def parse_controller(text: str) -> tuple[str, Mode, bool]:
    """``robust``, ``robust:held``, ``robust:free``, ``robust:held:free``.

    Raises:
        InputError: Another word behind a colon.
    """
    name, *words = text.strip().split(":")
    for word in words:
        if word not in ("held", "live", "free"):
            raise InputError(f"no variant '{word}'", where=f"controller '{text}'", hint="use held, live or free")
    return name, "held" if "held" in words else "live", "free" in words


@lru_cache(maxsize=8)
def controller_factory(scenario: str, free: bool = False) -> ControllerFactory:
    """A scenario ready to run, kept for the next job.

    Raises:
        ImpactPostureError: The scenario cannot be read or set up.
    """
    return ControllerFactory(set_up(read_scenario(scenario)), free)


def execute(job: Job) -> tuple[tuple[Run, ...], dict[str, Any]]:
    """Run a job: its runs, and its document.

    Raises:
        ImpactPostureError: As :func:`impact_posture.simulation.run.run`, or the scenario cannot be set up.
    """
    factory = controller_factory(job.scenario, job.free)
    scenario = factory.setup.scenario
    if job.sign is not None and job.sign not in getattr(scenario.task, "signs", ()):
        raise InputError(f"is not pushed with sign {job.sign}", where=scenario.name, hint="leave --sign out")
    runs = run(factory, job.controller, seed=job.seed, mode=job.mode, gain=job.gain, only=job.sign)
    metrics, found = [measure(factory.setup, one) for one in runs], []
    for one, measured in zip(runs, metrics, strict=True):
        found.append(_of_run(factory, one, measured))
    status = gravest(part["status"] for part in found)
    document = {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "source": scenario.source,
        "controller": job.controller,
        "mode": job.mode,
        "free": job.free,
        "gain": scenario.control.robust.gain if job.gain is None else job.gain,
        "seed": job.seed,
        "status": status,
        "events": [{**event, "sign": part["sign"]} for part in found for event in part["events"]],
        "metrics": together(metrics).to_dict() if status == "completed" else None,
        "windows": [{**window, "sign": part["sign"]} for part in found for window in part["windows"]],
        "prediction": (
            _mean_prediction([p for part in found for p in part["prediction"]]) if status == "completed" else None
        ),
        "runs": found,
        "offline": _offline(factory) if job.controller == "posture" else None,
        "model_sha256": factory.setup.robot.model_sha256,
        "versions": versions() | {"mujoco": _mujoco_version()},
    }
    return runs, finite(document)


def finite(content: Any) -> Any:
    """The same document with ``None`` for what is not finite: JSON has no word for it."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    if isinstance(content, float) and not np.isfinite(content):
        return None
    return content


def together(metrics: list[Metrics]) -> Metrics:
    """Of several runs: means; ticks summed, stops united, the largest of what is a largest."""
    first = metrics[0]
    if len(metrics) == 1:
        return first
    values = {key: float(np.mean([getattr(m, key) for m in metrics])) for key in asdict(first) if key != "stops"}
    counts = ("relaxed_ticks", "failed_ticks", "contacts", "contacts_asked")
    ticks = {key: sum(getattr(m, key) for m in metrics) for key in counts}
    largest = {key: max(getattr(m, key) for m in metrics) for key in ("peak_jump_max", "peak_force")}
    stops = tuple(dict.fromkeys(stop for m in metrics for stop in m.stops))
    return Metrics(**{**values, **ticks, **largest, "stops": stops, "rested": all(m.rested for m in metrics)})


def _of_run(factory: ControllerFactory, one: Run, metrics: Metrics) -> dict[str, Any]:
    events = judge(factory.setup, one)
    return {
        "sign": one.sign,
        "waited": None if np.isnan(one.waited) else one.waited,
        "status": gravest(event.status for event in events),
        "events": [event.to_dict() for event in events],
        "ticks": int(one.series.t.size),
        "metrics": metrics.to_dict(),
        "windows": [window.to_dict() for window in one.windows],
        "prediction": [p.to_dict() for p in predict(factory.setup, factory.objective(), one)],
    }


def _mean_prediction(impacts: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the impacts; ``None`` where one is undefined."""
    found: dict[str, Any] = {"impacts": len(impacts)}
    for key in ("H", "G", "V", "S", "approach", "frictionless", "sticking", "measured", "ratio"):
        values = [impact[key] for impact in impacts]
        found[key] = None if not values or None in values else float(np.mean(values))
    return found


def _offline(factory: ControllerFactory) -> dict[str, Any]:
    found = factory.offline
    return {**asdict(found), "q": [float(value) for value in found.q]}


def _mujoco_version() -> str:
    from impact_posture.dynamics.mjcf import import_mujoco

    return str(import_mujoco().__version__)
