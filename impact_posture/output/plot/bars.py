"""Figure ``bars``: motion during impacts for each controller and scenario, compared with Afifi et al. 2026."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impact_posture.errors import InputError
from impact_posture.output.plot.result_view import SEPARATOR, number
from impact_posture.output.plot.style import AFTER_BAR, BEFORE_BAR, INK, SMALL, VERMILLION, framed, shared_legend
from impact_posture.system.escape import plot_label

NOTES = (
    "∫‖ν‖dt mixes meters and radians, as in the paper. Intervals: 95 % of the mean over the seeds. The paper does "
    "not print its controller gains. Compare the numbers of the paper only with each other.",
)
# The axis includes values of the paper up to this multiple of the largest mean.
_FAR = 2.0


@dataclass(frozen=True)
class Bar:
    """Bar for one controller in one scenario: ``q_total_impact = ∫‖ν‖dt`` over the impact windows.

    Attributes:
        mean: Mean over the runs; NaN if no run completed.
        half_width: Half width of the 95 % interval; 0 for a single run.
        paper: Value in the paper for the same controller; ``None`` if the paper has no value.
    """

    scenario: str
    controller: str
    mean: float
    half_width: float = 0.0
    paper: float | None = None


def bars_figure(rows: Sequence[Bar]) -> Figure:
    """Draw horizontal bars with intervals and the values of the paper.  Each scenario has a panel."""
    if not rows:
        raise InputError("there is nothing to draw", where="figure bars", hint="give at least one row")
    scenarios = list(dict.fromkeys(row.scenario for row in rows))
    groups = [[row for row in rows if row.scenario == name] for name in scenarios]
    columns = min(2, len(groups))
    lines = [groups[k : k + columns] for k in range(0, len(groups), columns)]
    heights = [0.55 + 0.3 * max(len(group) for group in line) for line in lines]
    lead = "Motion during impacts, ∫‖ν‖dt over the impact windows"
    facts = ["less is better", "the same windows for every controller", "bars: this package, mean and 95 % interval"]
    with framed(lead, [SEPARATOR.join(facts)], sum(heights) + 0.4, NOTES) as (figure, body):
        panels = body.subplots(len(lines), columns, squeeze=False, height_ratios=heights)
        for axes in panels.flat[len(groups) :]:
            axes.set_visible(False)
        for axes, name, group in zip(panels.flat, scenarios, groups, strict=False):
            _panel(axes, name, group, max(len(other) for other in groups))
        shared_legend(body, _handles(rows), "lower")
    return figure


def _panel(axes: Any, name: str, group: Sequence[Bar], room: int) -> None:
    ours = max((row.mean + row.half_width for row in group if np.isfinite(row.mean)), default=0.0)
    papers = [row.paper for row in group if row.paper is not None]
    # The paper used another robot, so its values can be much larger.  An axis up to the largest value would make the
    # bars short.
    near = [paper for paper in papers if paper <= _FAR * ours or ours == 0]
    end = 1.08 * (max([ours, *near]) or 1.0)
    for place, row in enumerate(group):
        if np.isfinite(row.mean):
            axes.barh(place, row.mean, height=0.6, **(BEFORE_BAR if row.controller == "nominal" else AFTER_BAR))
            if row.half_width:
                axes.errorbar(row.mean, place, xerr=row.half_width, color=INK, linewidth=1.0, capsize=2.5, zorder=4)
        if row.paper is not None:
            axes.plot(min(row.paper, 0.975 * end), place, **(_PAPER if row.paper in near else _BEYOND))
        # The values are written to the right of the panel, where no bar covers them.
        look = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "va": "center", "size": SMALL}
        axes.annotate(_words(row), (1.0, place), (5, 0), **look)
    axes.set_xlim(0.0, end)
    axes.set_ylim(room - 0.4, -0.6)
    axes.set_yticks(range(len(group)), [plot_label(row.controller) for row in group])
    axes.tick_params(axis="y", length=0)
    axes.locator_params(axis="x", nbins=5)
    axes.grid(True, axis="x")
    axes.set_title(plot_label(name))
    axes.set_xlabel("∫‖ν‖dt  [m, rad]")


_PAPER: dict[str, Any] = {
    "linestyle": "", "marker": "D", "markersize": 4.5, "color": "white", "markeredgecolor": VERMILLION,
    "markeredgewidth": 1.2, "zorder": 5,
}  # fmt: skip
_BEYOND = _PAPER | {"marker": ">", "markersize": 6}


def _words(row: Bar) -> str:
    """Format mean, interval and value of the paper.  The half width of the interval has two significant digits."""
    paper = f"\npaper {number(row.paper)}" if row.paper is not None else ""
    if not np.isfinite(row.mean):
        return "no run ended" + paper
    if not row.half_width:
        return number(row.mean) + paper
    digits = max(1 - int(np.floor(np.log10(row.half_width))), 0)
    return f"{row.mean:.{digits}f} ± {row.half_width:.{digits}f}{paper}"


def _handles(rows: Sequence[Bar]) -> list[Any]:
    handles: list[Any] = []
    if any(row.controller == "nominal" for row in rows):
        handles.append(Patch(label="nominal", **BEFORE_BAR))
    if any(row.controller != "nominal" for row in rows):
        handles.append(Patch(label="others", **AFTER_BAR))
    if any(row.paper is not None for row in rows):
        handles.append(Line2D([], [], label="paper", **_PAPER))
        handles.append(Line2D([], [], label="paper, beyond the axis", **_BEYOND))
    return handles
