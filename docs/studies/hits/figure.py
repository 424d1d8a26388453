"""Figure of the hits: measured joint velocities, and the jumps that two joint models predict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from docs.studies.core import ROOT, Vector
from docs.studies.hits.arm import Arm
from docs.studies.hits.recordings import AVERAGED, PERIOD, Group, Hit
from impact_posture.output.plot.style import BLUE, GRAY, PALE, SMALL, TEXT, VERMILLION, WIDTH

if TYPE_CHECKING:
    from docs.studies.hits.study import Evaluation

PICTURE = ROOT / "docs" / "images" / "hits.png"
JOINTS_SHOWN = (0, 2, 3, 5)
_SPAN = (-10.0, 50.0)  # ms
_STYLES = {"reflected": (BLUE, "-"), "link": (VERMILLION, (0, (4, 2)))}


def course(hit: Hit, arm: Arm) -> tuple[Vector, Vector]:
    """Return times after the contact, ms, and joint velocities relative to trend and controller, rad/s, (k, 7)."""
    times, rates = hit.deviation()
    commands = np.array([hit.impulse(hit.command, max(0, k + 1 - hit.contact)) for k in range(len(rates))])
    return 1e3 * times, rates - np.linalg.solve(arm.inertia(hit.q[hit.contact]), commands.T).T


def figure(groups: Mapping[Group, Sequence[Hit]], best: Evaluation) -> Figure:
    """Draw one column for each group and one row for each shown joint."""
    drawing = Figure(figsize=(WIDTH, 5.6), layout="constrained")
    panels = drawing.subplots(len(JOINTS_SHOWN), len(groups), sharex=True, sharey="row", squeeze=False)
    for column, (group, hits) in enumerate(groups.items()):
        jumps = best.jumps(group)
        start, stop = AVERAGED[group.box]
        for row, joint in enumerate(JOINTS_SHOWN):
            axes = panels[row, column]
            axes.axvspan(1e3 * PERIOD * start, 1e3 * PERIOD * stop, color=PALE, linewidth=0)
            for hit in hits:
                times, rates = course(hit, best.fit.arm)
                shown = (times >= _SPAN[0]) & (times <= _SPAN[1])
                axes.plot(times[shown], rates[shown, joint], color=GRAY, linewidth=0.7, alpha=0.7, label="measured")
            for name, (color, dashes) in _STYLES.items():
                steps = [0.0, 0.0, jumps[name][joint], jumps[name][joint]]
                ends = [_SPAN[0], 0.0, 0.0, _SPAN[1]]
                axes.plot(ends, steps, color=color, linestyle=dashes, linewidth=1.5, label=f"predicted, {name}")
            axes.grid(True, linewidth=0.4, color=PALE)
            axes.set_xlim(*_SPAN)
            axes.tick_params(labelsize=SMALL)
            if row == 0:
                axes.set_title(str(group).replace(", ", "\n"), fontsize=TEXT)
            if column == 0:
                axes.set_ylabel(f"joint {joint + 1}, rad/s", fontsize=TEXT)
    for axes in panels[-1]:
        axes.set_xlabel("time, ms", fontsize=TEXT)
    labels = dict(zip(*reversed(panels[0, 0].get_legend_handles_labels()), strict=True))
    drawing.legend(labels.values(), labels.keys(), loc="outside upper center", ncols=3, frameon=False, fontsize=TEXT)
    return drawing


def draw(groups: Mapping[Group, Sequence[Hit]], best: Evaluation) -> None:
    figure(groups, best).savefig(PICTURE, dpi=150)
