"""Simulate impacts in a series of postures: an arm with several elbow angles, and a humanoid from start to optimum.

The nominal controller keeps the robot in each posture during the impact.  Only the posture changes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from docs.studies.core import ROOT, Request, Vector, cell, collected, table
from docs.studies.robustness.draws import Draw, prepare
from docs.studies.robustness.envelope import percent
from docs.studies.robustness.page import MARK
from impact_posture.experiment.jobs import Job, execute
from impact_posture.output.plot.style import AFTER, BEFORE, FREE_BEFORE, GRAY, GREEN, WIDTH, style
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.manifold.feasible_start import Projector
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.offline_posture import offline_posture, scenario_requirements
from impact_posture.simulation.scenario_file import SinglePush
from impact_posture.simulation.scenario_objective import interpreted, scenario_objective
from impact_posture.simulation.setup import Setup
from impact_posture.simulation.world.world import build_world

ARM, HUMANOID = "aerial-vertical", "talos-push"
PICTURE = ROOT / "docs" / "images" / "where-bracing-helps.png"
# Bend of the elbow at the start of the shipped scenario, rad.
_SHIPPED = 0.9
# Largest bend of the elbow in the scan, rad.
_LARGEST = 1.5
# Time before the push, s.  A short time suffices, because the humanoid starts in the posture that the controller
# keeps.
_SETTLE = 1.0
# The line of the jump is dashed, because for a push it coincides with the line of the motion.
_JUMP = {"color": GREEN, "linestyle": (0, (2, 2)), "linewidth": 1.6, "zorder": 3.2}


@dataclass(frozen=True)
class Place:
    """Results at one posture of a scan.

    Attributes:
        at: Elbow angle, rad, or for the humanoid the position between start (0) and optimum (1).
        H: Predicted squared velocity jump per squared impulse.
        V: Predicted squared velocity jump per squared approach speed, without friction.
        S: Predicted squared velocity jump per squared approach speed if the contact sticks, or ``None``.
        motion: Motion in the impact windows, ``q_total_impact``.
        jump: Largest velocity jump, ``peak_jump``.
        force: Largest normal force, N.
    """

    at: float
    H: float
    V: float
    S: float | None
    motion: float
    jump: float
    force: float
    status: str


def lines(request: Request) -> Iterator[str]:
    """Run both scans, yield their tables, and draw the picture if the page is written."""
    scans = {name: _scan(name, request) for name in (ARM, HUMANOID) if request.only in name}
    yield " ".join(_caption(scans))
    yield from ("", MARK, "")
    for name, places in scans.items():
        yield from _told(name, places)
    if request.write:
        draw(scans[ARM], scans[HUMANOID])


def _caption(scans: Mapping[str, Sequence[Place]]) -> Iterator[str]:
    if ARM in scans:
        fine = [p for p in scans[ARM] if p.status == "completed"]
        start = min(fine, key=lambda p: abs(p.at - _SHIPPED))
        best, last = min(fine, key=lambda p: p.H), fine[-1]
        most = max((p for p in fine if p.at < start.at), key=lambda p: p.motion)
        yield (
            "Left: the arm over the floor, with the bend of the elbow as its only redundancy. H is lowest at "
            f"{best.at:g} rad, where {_against(best, start)}. On the way there from the shipped "
            f"{start.at:g} rad, the motion at first changes by {percent(most.motion / start.motion - 1)} (at "
            f"{most.at:g} rad). In the other direction, at {last.at:g} rad, H rises from {start.H:.0f} to "
            f"{last.H:.0f}, and {_against(last, start)}."
        )
    if HUMANOID in scans:
        fine = [p for p in scans[HUMANOID] if p.status == "completed"]
        start, end, most = fine[0], fine[-1], max(fine, key=lambda p: p.V)
        yield (
            f"Right: the humanoid on the straight line from its start to the offline optimum, on its feet. √H falls "
            f"to {math.sqrt(end.H / start.H):.2f} and the motion to {end.motion / start.motion:.2f}, while √V first "
            f"rises to {math.sqrt(most.V / start.V):.2f}: a push has an impulse, not a speed."
        )


def _against(place: Place, start: Place) -> str:
    motion, jump = (percent(getattr(place, name) / getattr(start, name) - 1) for name in ("motion", "jump"))
    force = place.force / start.force
    return f"the motion changes by {motion}, the jump by {jump}, and the force becomes {force:.2g} times as large"


def _scan(name: str, request: Request) -> list[Place]:
    setups = dict(zip(_places(name, request.count), _setups(name, request.count), strict=True))
    steps = list(setups)

    def one(index: int) -> Place:
        return _place(steps[index], setups[steps[index]])

    return collected(one, len(steps), request.jobs, name)


def _places(name: str, count: int) -> Vector:
    """Return the values of :attr:`Place.at` at which the arm or the humanoid is simulated."""
    if name == HUMANOID:
        return np.linspace(0.0, 1.0, count)
    return np.unique(np.append(np.linspace(0.0, _LARGEST, count), _SHIPPED).round(6))


def _setups(name: str, count: int) -> Iterator[Setup]:
    places = _places(name, count)
    if name == ARM:
        yield from (prepare(Draw(ARM, 0, values={"elbow": float(bend)})) for bend in places)
        return
    shipped = prepare(Draw(HUMANOID, 0))
    objective = scenario_objective(shipped)
    robot, optimum = shipped.robot, offline_posture(shipped, objective).q
    problem = build_problem(robot, objective, shipped.q, replace(
        scenario_requirements(shipped, objective), collision=False, holdable=False,
    ))  # fmt: skip
    task = shipped.scenario.task
    assert isinstance(task, SinglePush)
    scenario = replace(shipped.scenario, push=replace(task, settle=_SETTLE))
    way = pin.difference(robot.model, shipped.q, optimum)
    for share in places:
        # Take a point on the straight line from start to optimum, and project it so that the feet keep their places.
        q = Projector(problem).project(np.asarray(pin.integrate(robot.model, shipped.q, share * way))).q
        yield Setup(scenario, robot, q, build_world(robot, scenario, q))


def _place(at: float, setup: Setup) -> Place:
    factory = ControllerFactory(setup, gradient_of=interpreted)
    _, document = execute(Job(setup.scenario.name, "nominal"), factory)
    here = factory.objective().oracle.quantities(setup.q)
    metrics: Mapping[str, Any] = document["metrics"] or {}
    nothing = math.nan
    return Place(
        float(at), here.H, here.V, here.S, metrics.get("q_total_impact", nothing), metrics.get("peak_jump", nothing),
        metrics.get("peak_force", nothing), document["status"],
    )  # fmt: skip


def _told(name: str, places: Sequence[Place]) -> Iterator[str]:
    what = "elbow, rad" if name == ARM else "share of the line to the optimum"
    yield from (f"`{name}`, the nominal controller in each posture:", "")
    head = (what, "H", "V", "S", "motion", "jump", "force, N", "status")
    body = [
        [f"{p.at:.3g}", *(f"{v:.3g}" if v is not None else "–" for v in (p.H, p.V, p.S, p.motion, p.jump)),
         cell(p.force, 0), p.status]
        for p in places
    ]  # fmt: skip
    yield from table(head, body)
    yield ""


def draw(arm: Sequence[Place], humanoid: Sequence[Place]) -> None:
    """Draw the predictions above the measurements, one column for each scan."""
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
        axes: Any = figure.subplots(2, 2, sharex="col")
        _column(axes[:, 0], arm, _SHIPPED)
        _column(axes[:, 1], humanoid, 0.0)
        axes[0, 0].set_title("an arm that comes down on a floor")
        axes[0, 1].set_title("a humanoid that is pushed")
        axes[1, 0].set_xlabel("bend of the elbow, rad (0: stretched)")
        axes[1, 1].set_xlabel("share of the way from the start to the optimum")
        axes[0, 0].set_ylabel("the model says (shipped start = 1)")
        axes[1, 0].set_ylabel("measured (shipped start = 1)")
        PICTURE.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(PICTURE, dpi=200)


def _column(axes: Any, places: Sequence[Place], start: float) -> None:
    fine = [p for p in places if p.status == "completed"]
    first = min(fine, key=lambda p: abs(p.at - start))
    model = {"√H: per impulse": ("H", BEFORE), "√V: per speed, sliding": ("V", {**FREE_BEFORE, "color": GRAY}),
             "√S: per speed, sticking": ("S", {**AFTER, "color": GREEN})}  # fmt: skip
    measured = {"motion": ("motion", AFTER), "velocity jump": ("jump", _JUMP),
                "peak force": ("force", BEFORE)}  # fmt: skip
    for axis, curves, power in ((axes[0], model, 0.5), (axes[1], measured, 1.0)):
        for label, (name, look) in curves.items():
            values = np.array([getattr(p, name) for p in fine], dtype=float) / float(getattr(first, name))
            axis.plot([p.at for p in fine], values**power, label=label, marker="o", markersize=2.5, **look)
        axis.axvline(first.at, color=GRAY, linewidth=0.8, label="shipped start")
        axis.set_ylim(bottom=0.0)
        axis.legend(loc="best", handlelength=2.6, frameon=True, framealpha=1, edgecolor="none")
        axis.grid(visible=True)
