"""Figure ``self_motion``: the objective over the self-motion manifold, if it has one or two dimensions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart
from impact_posture.errors import printable
from impact_posture.output.plot.path_figures import log_axis, spreads
from impact_posture.output.plot.result_view import ResultView, header_lines, objective_unit, required
from impact_posture.output.plot.style import BLUE, GRAY, INK, PALE, VERMILLION, framed, shared_legend
from impact_posture.system.arrays import Array

if TYPE_CHECKING:
    from impact_posture.posture.search.global_search import SelfMotionMap

_CURVES = "Each curve is one component: it is closed, or runs from one limit to another."
_SURFACES = "Each panel is one component, over the two joints that move most on it; folds may cover each other."
_GRAY = "Gray: limits or inequalities are violated. Postures that differ by full turns count as one."
# Maximum number of surfaces in the figure.
_PANELS = 4
# Gap between curves, as a share of the sum of their lengths.
_GAP = 0.03
_MARKS: dict[str, dict[str, Any]] = {
    "ends": {"marker": "o", "markersize": 7, "markerfacecolor": "none", "markeredgecolor": INK, "zorder": 5},
    "start": {"marker": "s", "markersize": 6, "color": VERMILLION, "zorder": 6},
    "optimum": {"marker": "*", "markersize": 11, "color": BLUE, "markeredgecolor": INK, "zorder": 7},
}
_LABELS = {"ends": "optima of multi-start", "start": "start", "optimum": "optimum"}


def self_motion_figure(view: ResultView) -> Figure:
    """Draw the objective over path length if the manifold is one-dimensional, otherwise as a map of each surface."""
    data = required(view.self_motion, "map", "self_motion", "run optimize again with `search` global")
    curves, known = bool(data.s.any()), np.isfinite(data.objective) & (data.objective > 0)
    y = np.where(known, data.objective, np.nan)
    with framed(*header_lines(view), 3.4, [_CURVES if curves else _SURFACES, _GRAY]) as (figure, body):
        label = f"objective ({view.objective.kind})  [{objective_unit(view)}]"
        axes = _draw_curves(body, data, y, label) if curves else _draw_surfaces(body, data, y, label, view)
        shared_legend(body, axes.get_legend_handles_labels()[0], "lower")
    return figure


def _draw_curves(body: Any, data: SelfMotionMap, y: Array, label: str) -> Any:
    axes = body.subplots()
    count = int(data.component.max()) + 1
    lengths = np.array([data.s[data.component == k].max() for k in range(count)])
    gap = _GAP * lengths.sum()
    offsets = np.concatenate([[0.0], np.cumsum(lengths + gap)])
    x = data.s + offsets[data.component]
    for k in range(count):
        mine = data.component == k
        names = ("infeasible", "feasible") if k == 0 else (None, None)
        axes.plot(x[mine], y[mine], color=GRAY, linewidth=0.8, linestyle=(0, (1, 1.5)), label=names[0])
        axes.plot(x[mine], np.where(data.feasible, y, np.nan)[mine], color=BLUE, linewidth=1.6, label=names[1])
        if k:
            axes.axvline(offsets[k] - gap / 2, color=PALE, linewidth=0.8)
    _mark(axes, data, x, y, np.ones(len(x), dtype=bool))
    if spreads(y[np.isfinite(y)]):
        log_axis(axes)
    axes.grid(True, axis="y")
    axes.set_xlabel("path length along each component, ∫‖dq‖  [rad, mixed with m]")
    axes.set_ylabel(label)
    return axes


def _draw_surfaces(body: Any, data: SelfMotionMap, y: Array, label: str, view: ResultView) -> Any:
    sizes = np.bincount(data.component)
    # The component with the optimum comes first, then the component with the most points.
    order = sorted(range(len(sizes)), key=lambda k: (k != data.component[data.optimum[0]], -sizes[k]))[:_PANELS]
    panels = body.subplots(1, len(order), squeeze=False)[0]
    chart = Chart(view.robot.model)
    joints = [s.x.start for s in chart.slots if s.kind.family in ("revolute", "continuous", "prismatic")]
    x = np.array([chart.to_x(q) for q in data.q])
    shown = y[data.feasible & np.isfinite(y)]
    norm = LogNorm(shown.min(), np.quantile(shown, 0.95)) if shown.size and shown.max() > shown.min() else None
    image = None
    for axes, k in zip(panels, order, strict=True):
        mine = data.component == k
        # The axes are the two joint coordinates with the largest range.
        pair = [joints[i] for i in np.argsort(-np.ptp(x[mine][:, joints], axis=0), kind="stable")[:2]]
        for index, name in zip(pair, ("x", "y"), strict=True):
            slot = next(s for s in chart.slots if s.x.start <= index < s.x.stop)
            unit = "m" if slot.kind.family == "prismatic" else "rad"
            getattr(axes, f"set_{name}label")(f"{printable(slot.name, longest=30)}  [{unit}]", parse_math=False)
        first, second = x[:, pair[0]], x[:, pair[1]]
        out, good = mine & ~data.feasible, mine & data.feasible
        axes.plot(first[out], second[out], linestyle="", marker=".", markersize=2, color=PALE)
        image = axes.scatter(first[good], second[good], c=y[good], s=5, norm=norm, cmap="viridis", linewidths=0)
        _mark(axes, data, first, second, mine)
    body.colorbar(image, ax=list(panels), label=label)
    return panels[0]


def _mark(axes: Any, data: SelfMotionMap, x: Array, y: Array, mine: NDArray[np.bool_]) -> None:
    """Mark the start, the optimum and the optima of the multi-start search that belong to the points ``mine``."""
    for name, look in _MARKS.items():
        places = getattr(data, name)
        here = places[mine[places]]
        axes.plot(x[here], y[here], linestyle="", label=_LABELS[name], **look)
