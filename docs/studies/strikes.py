"""Simulate planned strikes, and compare them with strikes from the nominal posture and with the reference flow.

A seed varies the speed, and the tilt and the place of the surface, which the controllers do not know.  Finished runs
are stored in build/strikes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from statistics import mean, median
from typing import Any

import numpy as np

from docs.studies.core import ROOT, Request, collected, kept, table
from docs.studies.real_impacts import scenario_of
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError
from impact_posture.experiment.job_store import key_of
from impact_posture.experiment.jobs import Job, execute
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jumps
from impact_posture.simulation.controllers.contact_reference import Reference
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import before, saturated
from impact_posture.simulation.offline_posture import OfflinePosture, offline_posture
from impact_posture.simulation.outcome import judge
from impact_posture.simulation.prediction import predict
from impact_posture.simulation.run import Run
from impact_posture.simulation.run import run as simulate
from impact_posture.simulation.scenario_file import RepeatedContacts, Scenario, Spread
from impact_posture.simulation.seed_variation import set_up_with
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.system.arrays import Array

# A number after a name replaces the approach speed of the scenario, m/s.
CASES = (
    "ur5-strike", "panda-tap", "aerial-vertical", "aerial-lateral", "g1-strike 0.5", "g1-strike", "talos-strike 0.5",
    "talos-strike", "panda-wall",
)  # fmt: skip
CONTROLLERS = ("strike", "nominal", "robust-flow")
# Falls onto several feet, and their controllers.
FALLS = ("solo12-drop",)
LANDING = ("strike", "posture", "nominal")
SPREAD = Spread(speed=0.1, normal=5.0, gap=0.005)
# Largest error of the speed, as a share of the stated speed.
SPEED = 0.05
# Largest error of the time of the contact, s.
INSTANT = 0.01
# Longest time at an actuator limit, s.
SATURATED = 0.0
# Largest error of the jump, as a share of the predicted jump.
RATIO = 0.15
HEAD = (
    "controller", "contact speed, error in %", "contact instant, error in ms", "saturated before, ms",
    "measured / predicted jump", "jump, of nominal", "completed", "bars missed",
)  # fmt: skip
FOLDER = ROOT / "build" / "strikes"


def varied(case: str) -> tuple[Scenario, RepeatedContacts]:
    """Return the scenario of a case with the spread and a single contact, and its contact."""
    scenario = scenario_of(case)
    assert isinstance(scenario.task, RepeatedContacts)
    task = replace(scenario.task, count=1)
    return replace(scenario, spread=SPREAD, contacts=task), task


def struck(case: str, name: str, seed: int, offline: Callable[..., OfflinePosture]) -> dict[str, Any]:
    """Run a controller with a seed.  Return the errors at the contact and the outcome."""
    scenario, _ = varied(case)
    setup = set_up_with(scenario, seed)
    task = setup.scenario.task
    assert isinstance(task, RepeatedContacts)
    try:
        (record,), document = execute(
            Job(case.split()[0], name, seed, compile="auto"), ControllerFactory(setup, offline_of=offline)
        )
    except ImpactPostureError as error:
        return {"status": "no answer", "why": error.line, "plan": None, "contact": None}
    (window,), (part,), reference = record.of("impact"), document["runs"], Reference(task, setup.gap)
    # A point of the expected surface and a point of the true surface.
    stated, true = (each.world.built.points[task.surface] for each in (set_up(setup.scenario), setup))
    due = reference.start(0) + reference.crossing + scenario.normal @ (stated - true) / task.speed
    approach = record.series.slice(reference.start(0), window.begin)
    ticks = np.logical_or(*saturated(setup, record.series))[approach].sum()
    contact = None if not part["prediction"] else {
        "own": _of_own_speeds(setup, record) if setup.scenario.falls else None,
        "speed": part["prediction"][0]["approach"] / task.speed - 1,
        "instant": window.begin - float(due),
        "ratio": part["prediction"][0]["ratio"],
        "jump": part["prediction"][0]["measured"] / task.speed,
        "saturated": float(ticks * setup.scenario.control.period),
    }  # fmt: skip
    plan = (document["path"] or {}).get("strike")
    why = "; ".join(dict.fromkeys(event["what"] for event in document["events"]))
    return {"status": document["status"], "why": why, "plan": plan, "contact": contact}


def _of_own_speeds(setup: Setup, record: Run) -> float | None:
    """Return the measured jump divided by the jump of feet that land together, each with its own landing speed.

    The landing speed is the greatest speed towards the ground until the last foot has landed.
    """
    objective, (window,), series = ControllerFactory(setup).objective(), record.of("impact"), record.series
    k, ticks = before(series, window), series.slice(window.begin, window.begin + window.landing)
    speeds, numeric = [], Numeric(setup.robot.model)
    for q, v in zip(series.q[k : ticks.stop], series.v[k : ticks.stop], strict=True):
        model = numeric.at(q)
        points = [single.oracle.point for single in objective.singles]
        speeds.append([-setup.scenario.normal @ model.jacobian(point)[:3] @ v for point in points])
    (prediction,) = predict(setup, objective, record)
    landing = np.max(speeds, axis=0) * (1 + (prediction.restitution or 0.0))
    jumps = coulomb_jumps(objective, series.q[k], landing)
    return None if jumps is None else prediction.measured / jumps[0].norm


def results(case: str, name: str, seeds: range) -> list[dict[str, Any]]:
    """Return the results of all seeds.

    The optimum is computed once, for the speed of the first seed, but for falls once for each seed, because the seed
    changes the height of a fall.
    """
    first: list[OfflinePosture] = []

    def offline(*arguments: Any, **options: Any) -> OfflinePosture:
        if not first or case in FALLS:
            first.clear()
            first.append(offline_posture(*arguments, **options))
        return first[0]

    key = key_of(Job(case.split()[0], name, 0, compile="auto"))[:12]
    files = {seed: FOLDER / f"{case.replace(' ', '-')}-{name}-{seed}-{key}.json" for seed in seeds}
    return [kept(file, partial(struck, case, name, seed, offline)) for seed, file in files.items()]


def lines(request: Request) -> Iterator[str]:
    """Yield a table for each strike."""
    return _tables(request, CASES, CONTROLLERS)


def landing(request: Request) -> Iterator[str]:
    """Yield a table for each fall."""
    return _tables(request, FALLS, LANDING)


def _tables(request: Request, cases: Sequence[str], controllers: Sequence[str]) -> Iterator[str]:
    picked = [request.only] if request.only in cases else [case for case in cases if request.only in case]
    pairs = [(case, name) for case in picked for name in controllers]
    seeds = range(1, request.count + 1)
    answers = collected(lambda k: results(*pairs[k], seeds), len(pairs), request.jobs, "controllers")
    answer_of = dict(zip(pairs, answers, strict=True))
    yield (
        f"Each number is the median over {len(seeds)} seeds, followed by the worst value in parentheses. Bars "
        f"(largest allowed errors): speed within "
        f"{SPEED:.0%} of the stated speed, instant within {1e3 * INSTANT:g} ms, no saturation before the contact, "
        f"measured jump within {RATIO:.0%} of the predicted one, all runs completed. A seed changes the speed by "
        f"at most {SPREAD.speed:.0%}, tilts the surface by at most {SPREAD.normal:g}°, and shifts it by at most "
        f"{1e3 * SPREAD.gap:g} mm. The controllers do not know tilt and shift."
    )
    for case in dict.fromkeys(case for case, _ in pairs):
        _, task = varied(case)
        yield from ("", f"### {case.split()[0]}, {task.speed:g} m/s", "")
        rows = {name: answer_of[case, name] for name in controllers}
        base = [run["contact"]["jump"] for run in rows["nominal"] if run["contact"]]
        yield from table(HEAD, [_row(name, runs, base) for name, runs in rows.items()])
        notes = [f"- `{name}`: {note}." for name, runs in rows.items() for note in _notes(runs)]
        yield from ("", *notes) if notes else ()


def _row(name: str, runs: list[dict[str, Any]], base: list[float]) -> list[str]:
    contacts = [run["contact"] for run in runs if run["contact"]]
    done = sum(run["status"] == "completed" for run in runs)
    cells, missed = [f"`{name}`"], list[str]()
    for key, unit, aim, bar, style in (
        ("speed", 100, 0.0, SPEED, "+.1f"),
        ("instant", 1e3, 0.0, INSTANT, "+.1f"),
        ("saturated", 1e3, 0.0, SATURATED, ".0f"),
        ("ratio", 1, 1.0, RATIO, ".2f"),
    ):
        values = [contact[key] for contact in contacts if contact[key] is not None]
        worst = max(values, key=lambda value: abs(value - aim), default=None)
        if worst is None or len(values) < len(runs) or abs(worst - aim) > bar:
            missed.append(key)
        cells.append("–" if worst is None else f"{unit * median(values):{style}} ({unit * worst:{style}})")
    jumps = [contact["jump"] for contact in contacts]
    cells.append(f"{mean(jumps) / mean(base):.2f}" if jumps and base else "–")
    return [*cells, f"{done} of {len(runs)}", ", ".join([*missed, *["completed"] * (done < len(runs))]) or "none"]


def _notes(runs: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what happened first in runs that did not complete, and what the plan of the first run could not reach."""
    for (status, first), count in Counter((r["status"], r["why"].split("; ")[0]) for r in runs if r["why"]).items():
        yield f"{count} of {len(runs)} runs: {status}; {first.rstrip('.')}"
    own = [run["contact"]["own"] for run in runs if run["contact"] and run["contact"]["own"]]
    if own:
        worst = max(own, key=lambda ratio: abs(ratio - 1))
        yield f"measured jump / jump predicted with the landing speed of each foot: {median(own):.2f} ({worst:.2f})"
    plan = runs[0]["plan"]
    if plan is not None and plan["follow_through"] is not None:
        stop = plan["follow_through"]
        most = f", at most {plan['speed']:.2f} m/s, because of {plan['hindrance']}" if plan["hindrance"] else ""
        why = f" ({stop['hindrance']})" if stop["hindrance"] else ""
        length, stops = 1e3 * plan["run_up_m"], f"{stop['stopped']} of {stop['impacts']}"
        way = "fall from" if plan["run_up_s"] == 0 else "run-up of"
        yield f"planned {way} {length:.0f} mm{most}; can stop after {stops} impacts{why}"


# Scenarios in which the contact is early or late.
INSTANTS = ("panda-tap", "ur5-strike", "aerial-vertical", "g1-strike 0.5", "talos-strike 0.5")
# Delays of the contact, s.
LATE = (-0.05, -0.02, 0.0, 0.02, 0.05)
# Time from the contact to the measurement of the speed after the stop, s.
REST = 0.25
INSTANTS_HEAD = (
    "scenario", "contact, ms late", "its speed, m/s", "planned speed then, m/s", "measured / predicted jump",
    "at a limit in the run-up, ms", "after the contact, ms", f"speed {REST:g} s later, m/s", "outcome",
)  # fmt: skip


def instants(request: Request) -> Iterator[str]:
    """Yield a table of contacts before and after their expected instants."""
    cases = [case for case in INSTANTS if request.only in case]
    rows = collected(lambda k: list(_early_and_late(cases[k])), len(cases), request.jobs, "scenarios")
    yield from table(INSTANTS_HEAD, [row for part in rows for row in part])


def _early_and_late(case: str) -> Iterator[list[str]]:
    """Yield a row for each delay: the surface is nearer or farther than the controller expects."""
    scenario, task = varied(case)
    setup = set_up(scenario)
    factory, model = ControllerFactory(setup, compile="auto"), setup.robot.model
    path, objective, numeric, normal = factory.strike, factory.objective(), Numeric(model), scenario.normal
    assert path.strike is not None
    contact, point = path.strike.contact_s, objective.oracle.point
    reference = Reference(task, setup.gap)
    begin = reference.start(0) + reference.crossing

    def height(t: float) -> float:
        return float(normal @ numeric.at(path.at(t)[0]).placement(point).translation)

    def speed(q: Array, v: Array) -> float:
        return float(-normal @ numeric.at(q).jacobian(point)[:3] @ v)

    for late in LATE:
        # After the planned contact, the references continue with its speed.
        then = contact + min(late, 0.0)
        nearer = height(then) - height(contact) - max(late, 0.0) * path.strike.speed
        moved = replace(scenario.surface, gap=scenario.surface.gap - nearer)
        surfaces = tuple(moved if s == scenario.surface else s for s in scenario.surfaces)
        world = set_up(replace(scenario, surfaces=surfaces)).world
        shifted = replace(setup, world=world, expected_gap=setup.gap)
        repeated = ControllerFactory(shifted, compile="auto")
        vars(repeated)["strike"] = path
        (record,) = simulate(repeated, "strike")
        ((window,), series), limits = (record.of("impact"), record.series), []
        for first, last in ((begin + path.strike.run_up_s - contact, window.begin), (window.begin, window.end)):
            ticks = np.logical_or(*saturated(shifted, series))[series.slice(first, last)]
            limits.append(f"{1e3 * ticks.sum() * scenario.control.period:.0f}")
        made = predict(shifted, objective, record)
        k = int(np.searchsorted(series.t, window.begin + REST))
        events = judge(shifted, record)
        yield [
            f"`{case.split()[0]}`", f"{round(1e3 * (window.begin - begin)):+d}" if made else "–",
            f"{made[0].approach:.2f}" if made else "–", f"{speed(*path.at(then)[:2]):.2f}",
            f"{made[0].ratio:.2f}" if made else "–", *limits, f"{abs(speed(series.q[k], series.v[k])):.3f}",
            "; ".join(event.what for event in events) or "completed",
        ]  # fmt: skip
