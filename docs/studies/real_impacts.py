"""Compare predictions of the rigid model with simulated impacts of standing, fixed and flying robots.

The prediction does not use the simulated impact.  The inputs of the prediction are the speed of the scenario, and the
posture that the controller reaches if the robot moves exactly as planned.  Finished runs are stored in
build/real-impacts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from docs.studies.core import ROOT, Request, collected, kept, table
from impact_posture.errors import ImpactPostureError, MetricError
from impact_posture.experiment.job_store import key_of
from impact_posture.experiment.jobs import Job, execute
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.simulation.controllers.baselines import resting_posture
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS, ControllerFactory
from impact_posture.simulation.scenario_file import RepeatedContacts, Scenario, read_scenario
from impact_posture.simulation.setup import set_up
from impact_posture.simulation.world.throw import Throw, thrown_jumps

# A number after a name replaces the approach speed of the scenario, m/s.
SCENARIOS = (
    "talos-throw", "solo8-throw", "talos-strike", "talos-strike 0.5", "talos-strike 1.5", "g1-strike",
    "g1-strike 0.5", "g1-strike 1.5", "solo12-landing", "panda-tap", "hextilt-poke"
)  # fmt: skip
COMPARED = (
    "nominal",
    "robust",
    "robust-sticking",
    "robust-flow",
    "robust-flow-sticking",
    "posture",
    "posture-sticking",
    "stiff",
)
HEAD = (
    "controller", "predicted: H", "√S jump", "Coulomb jump", "of nominal", "measured jump", "of nominal",
    "motion in the window", "over the second", "peak force, N", "saturated in / out, s", "status",
)  # fmt: skip
FOLDER = ROOT / "build" / "real-impacts"


def scenario_of(name: str) -> Scenario:
    """Read a shipped scenario.

    A speed in the name replaces the approach speed, with enough acceleration for the gap.
    """
    shipped, *speed = name.split()
    scenario = read_scenario(shipped)
    if not speed:
        return scenario
    assert isinstance(scenario.task, RepeatedContacts)
    wanted, gap = float(speed[0]), next(s.gap for s in scenario.surfaces if s.name == scenario.task.surface)
    least = wanted**2 / (2 * gap) * 1.05
    task = replace(scenario.task, speed=wanted, acceleration=max(scenario.task.acceleration, least))
    words = f"{scenario.description}, at {wanted:g} m/s instead of {scenario.task.speed:g}"
    return replace(scenario, contacts=task, description=words)


def predicted(factory: ControllerFactory, name: str) -> dict[str, float | None]:
    """Predict H, the sticking jump and the Coulomb jump in the posture that a controller plans for the impact."""
    setup = factory.setup
    task, oracle = setup.scenario.task, factory.objective().oracle
    q = resting_posture(factory.driver(name), task.settle, ahead=setup.gap if setup.scenario.contacts else 0.0)
    quantities = oracle.quantities(q)
    if isinstance(task, Throw):
        _, sticking, coulomb = thrown_jumps(oracle, q, task, task.speed)
        return {"H": quantities.H, "sticking": sticking, "coulomb": coulomb}
    assert isinstance(task, RepeatedContacts)
    sticking = None if quantities.S is None else task.speed * float(np.sqrt(quantities.S))
    try:
        jump = task.speed * float(np.linalg.norm(coulomb_impact(oracle, q).jump))
    except MetricError:
        jump = None
    return {"H": quantities.H, "sticking": sticking, "coulomb": jump}


def result(scenario: str, name: str) -> dict[str, Any]:
    """Return the prediction and the run of a controller.  The result is stored under a hash of scenario, robot and
    code."""
    shipped = scenario.split()[0]
    key = key_of(Job(shipped, name, 0, compile="auto"))[:12]

    def compute() -> dict[str, Any]:
        try:
            factory = ControllerFactory(set_up(scenario_of(scenario)))
            before = predicted(factory, name)
            _, document = execute(Job(shipped, name, 0, compile="auto"), factory)
        except ImpactPostureError as error:
            return {"predicted": None, "status": "no answer", "metrics": None, "offline": "", "why": error.line}
        answer = {"predicted": before, "status": document["status"], "metrics": document["metrics"]}
        answer["offline"] = (document["offline"] or {}).get("note", "")
        answer["why"] = "; ".join(dict.fromkeys(event["what"] for event in document["events"]))
        return answer

    return kept(FOLDER / f"{scenario.replace(' ', '-')}-{name}-{key}.json", compute)


def lines(request: Request) -> Iterator[str]:
    controllers = [c for c in COMPARED if c in CONTROLLERS]
    # At other speeds, only the nominal controller, `robust`, and the variants for the objective `sticking` run.
    others = [c for c in controllers if c.endswith(("nominal", "robust", "sticking"))]
    pairs = [(s, c) for s in SCENARIOS if request.only in s for c in (others if " " in s else controllers)]
    answers = collected(lambda k: result(*pairs[k]), len(pairs), request.jobs, "runs")
    answer_of = dict(zip(pairs, answers, strict=True))
    for scenario in dict.fromkeys(s for s, _ in pairs):
        yield from (
            f"### {scenario}" + " m/s" * (" " in scenario),
            "",
            f"{scenario_of(scenario).description}. Seed 0.",
            "",
        )
        rows = {c: answer_of[s, c] for s, c in pairs if s == scenario}
        yield from table(HEAD, [_row(name, row, rows["nominal"]) for name, row in rows.items()])
        notes = [f"`{name}`: {text}" for name, row in rows.items() for text in (row["offline"], row["why"]) if text]
        yield from ("", *(f"- {note.rstrip('.')}." for note in notes), *([""] if notes else []))


def _row(name: str, row: dict[str, Any], nominal: dict[str, Any]) -> list[str]:
    before, base = row["predicted"] or {}, nominal["predicted"] or {}
    jumps = [before.get(key) for key in ("sticking", "coulomb")]
    cells = [f"`{name}`", _number(before.get("H")), *map(_number, jumps), _ratio(jumps[1], base.get("coulomb"))]
    metrics, nominal_metrics = row["metrics"], nominal["metrics"]
    if metrics is None:
        return [*cells, "–", "–", "–", "–", "–", "–", row["status"]]
    keys = ("peak_jump", "q_total_impact", "q_total_recovery")
    pairs = [(metrics[key], nominal_metrics and nominal_metrics[key]) for key in keys]
    saturation = metrics["saturation_s"]
    return [
        *cells, _number(pairs[0][0]), *(_ratio(*pair) for pair in pairs), f"{metrics['peak_force']:.0f}",
        f"{saturation['inside']:.2f} / {saturation['outside']:.2f}", row["status"],
    ]  # fmt: skip


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _ratio(value: float | None, base: float | None) -> str:
    return "–" if value is None or not base else f"{value / base:.2f}"
