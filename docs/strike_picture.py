"""Draw a planned and an unplanned contact of an aerial manipulator, for README.  Run with ``make pictures``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.lines import Line2D

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.impact_contact import point_on
from impact_posture.output.plot.postures_figure import HATCH, depth_of, draw_sticks, frame_flat, padded, side_plane
from impact_posture.output.plot.skeleton import build_skeleton
from impact_posture.output.plot.style import BLUE, GRAY, INK, VERMILLION, framed, save
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.run import Run, run
from impact_posture.simulation.scenario_file import RepeatedContacts, read_scenario
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.system.arrays import Array

IMAGES = Path(__file__).parent / "images"
# Scenario that is drawn.
SCENARIO = "aerial-vertical"
# Time before the approach, s.
SETTLE = 2.5
# Number of drawn postures.  The distances between these postures, along the path of base and joints, are equal.
POSTURES = 5
# Time from the contact to the last posture, s.
AFTER = 0.1
# Time interval, relative to the contact, in which the speed is drawn, s.
SPAN = (-0.45, 0.15)


def main() -> None:
    """Simulate one contact of the controllers ``nominal`` and ``strike``, and draw both."""
    scenario = read_scenario(SCENARIO)
    assert isinstance(scenario.task, RepeatedContacts)
    factory = ControllerFactory(set_up(replace(scenario, contacts=replace(scenario.task, count=1, settle=SETTLE))))
    setup, plan = factory.setup, factory.strike.strike
    assert plan is not None
    (strike,), (nominal,) = run(factory, "strike"), run(factory, "nominal")
    series, contact = strike.series, strike.of("impact")[0].begin
    ticks = series.slice(0.0, contact + AFTER)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(series.q[ticks], axis=0), axis=1)))
    chosen = np.searchsorted(length, np.linspace(0.0, length[-1], POSTURES)).clip(max=len(length) - 1)
    states = [build_skeleton(setup.robot, series.q[k], [factory.objective().contact]) for k in chosen]
    plane = side_plane(states[0], states[-1])
    points = np.hstack([plane.axes @ state.points.T for state in states])
    low, high = padded(points.min(axis=1) - [0.0, 0.05], points.max(axis=1))
    jumps = [measure(setup, record).peak_jump for record in (strike, nominal)]
    title = f"{setup.robot.name} strikes a floor at {plan.stated_speed:g} m/s"
    words = [f"simulated; velocity jump ‖Δν‖ {jumps[0]:.2f}, in the start posture {jumps[1]:.2f} (m/s and rad/s)"]
    with framed(title, words, 2.7) as (figure, body):
        left, right = body.subplots(1, 2, width_ratios=[1.4, 1])
        floor = float(setup.world.built.points[scenario.task.surface][2])
        left.axhspan(low[1] - 1, floor, facecolor="white", edgecolor=GRAY, hatch=HATCH, linewidth=0, zorder=0.5)
        left.axhline(floor, color=INK, linewidth=1.0, zorder=1)
        shades = matplotlib.colormaps["Blues"](np.linspace(0.25, 1.0, POSTURES))
        for k, (state, shade) in enumerate(zip(states, shades, strict=True)):
            color = matplotlib.colors.to_hex(shade)
            look: dict[str, Any] = {"color": color, "linestyle": "-", "linewidth": 1.3, "zorder": 2 + 0.1 * k}
            draw_sticks(left, state, look, plane)
        frame_flat(left, low, high, 5)
        left.set(xlabel=f"{plane.right}  [m], seen along {depth_of(plane)}", ylabel=f"{plane.up}  [m]")
        for record, color, style in ((nominal, VERMILLION, "--"), (strike, BLUE, "-")):
            t, speeds = towards(setup, record)
            right.plot(t - record.of("impact")[0].begin, speeds, color=color, linestyle=style)
        right.axhline(plan.stated_speed, color=GRAY, linewidth=0.8, linestyle=":")
        right.axvline(0.0, color=GRAY, linewidth=0.8, linestyle=":")
        right.set(xlabel="time from the contact  [s]", ylabel="contact speed  [m/s]", xlim=SPAN)
        right.grid(visible=True)
        lines = [("start posture", VERMILLION, "--"), ("strike", BLUE, "-")]
        right.legend(handles=[Line2D([], [], label=a, color=b, linestyle=c) for a, b, c in lines], loc="lower left")
    save(figure, IMAGES, "strike-simulated")


def towards(setup: Setup, record: Run) -> tuple[Array, Array]:
    """Return times around the contact, s, and the speeds of the contact point towards the surface, m/s."""
    contact, series = record.of("impact")[0].begin, record.series
    ticks = series.slice(contact + SPAN[0], contact + SPAN[1])
    speeds = [approach(setup, q, v) for q, v in zip(series.q[ticks], series.v[ticks], strict=True)]
    return series.t[ticks], np.array(speeds)


def approach(setup: Setup, q: Array, v: Array) -> float:
    """Return the speed of the contact point towards the surface, m/s."""
    point = point_on(setup.robot, setup.scenario.shape.frame, setup.scenario.offset)
    return float(-setup.scenario.normal @ Numeric(setup.robot.model).at(q).jacobian(point)[:3] @ v)


if __name__ == "__main__":
    main()
