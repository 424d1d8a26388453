"""Draw panels over time for figures of runs: shaded windows, limits, curves and a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator

from impact_posture.output.plot.path_figures import log_axis, spreads
from impact_posture.output.plot.run_panels import LINES, RUNS, Clip, Panel
from impact_posture.output.plot.run_view import RunView, run_header
from impact_posture.output.plot.style import BAND, GRAY, INK, SHADES, SMALL, framed, shared_legend
from impact_posture.system.arrays import Array
from impact_posture.system.escape import plot_label

LIMIT: dict[str, Any] = {"color": INK, "linestyle": (0, (6, 3)), "linewidth": 0.8, "zorder": 1.5}
STOP: dict[str, Any] = {"color": INK, "linewidth": 3.6, "alpha": 0.35, "zorder": 2.0, "solid_capstyle": "butt"}
AT_LIMIT: dict[str, Any] = {
    "linestyle": "", "marker": "D", "markersize": 3.2, "color": INK, "markeredgecolor": "white",
    "markeredgewidth": 0.4, "zorder": 5,
}  # fmt: skip
# Number of bins of ticks across the width of a panel.
_BINS = 1000


@dataclass(frozen=True)
class Cell:
    """Place of a panel in a figure, with a title above it.

    Attributes:
        clips: Index of a run → time interval in which the run is drawn.
        frame: Index of the run whose windows are shaded, and the time interval of the axis.
    """

    panel: Panel
    clips: Mapping[int, Clip]
    frame: tuple[int, Clip]
    title: str = ""

    @classmethod
    def of(cls, panel: Panel, which: int, clip: Clip, title: str = "") -> Cell:
        """Return a cell that shows a single run."""
        return cls(panel, {which: clip}, (which, clip), title)


def time_figure(
    views: Sequence[RunView],
    cells: Sequence[Sequence[Cell | None]],
    height: float,
    notes: Sequence[str],
    *,
    widths: Sequence[float] = (),
    title_at: str = "center",
    air: float = 0.75,
) -> Figure:
    """Draw rows of cells with a header above and the legend beside them.  A cell that is ``None`` stays empty.

    Cells with the same panel share the limits of their vertical axes.  If cells of a column have the same time axis,
    only the lowest cell has a label.  ``height`` of a row and additional ``air`` are in inches.  ``widths`` are the
    relative widths of the columns.  ``notes`` are sentences below the figure.  ``title_at`` is ``center`` or
    ``left``.
    """
    columns = len(cells[0])
    shown: dict[Panel, list[Any]] = {}
    with framed(*run_header(views), height * len(cells) + air, notes) as (figure, body):
        ratios = list(widths[:columns]) or None
        axes = body.subplots(len(cells), columns, squeeze=False, width_ratios=ratios)
        for row, column in np.ndindex(*axes.shape):
            cell, place = cells[row][column], axes[row, column]
            if cell is None:
                place.set_axis_off()
                continue
            _draw(place, cell, views)
            shown.setdefault(cell.panel, []).append(place)
            place.set_title(cell.title, loc=title_at, fontweight="bold")
            below = cells[row + 1][column] if row + 1 < len(cells) else None
            if below is None or below.frame != cell.frame:
                place.set_xlabel(cell.frame[1].label)
            else:
                place.tick_params(labelbottom=False)
            if column == 0:
                place.set_ylabel(cell.panel.label)
            else:
                place.tick_params(labelleft=False)
        for same in shown.values():
            limits = np.array([place.get_ylim() for place in same])
            for place in same:
                place.set_ylim(limits.min(), limits.max())
        body.align_ylabels(list(axes[:, 0]))
        heads = [(panel.label.split("  [")[0] + ":", same[0]) for panel, same in shown.items()]
        _legend(body, _common_handles(views, list(shown)), heads)
    return figure


def _draw(axes: Any, cell: Cell, views: Sequence[RunView]) -> None:
    panel, (shown, frame) = cell.panel, cell.frame
    for kind, shade in SHADES.items():
        for window in views[shown].windows:
            if window.kind == kind and window.end > frame.begin and window.begin < frame.end:
                axes.axvspan(frame.x(window.begin), frame.x(window.end), **shade)
    axes.set_xlim(frame.x(frame.begin), frame.x(frame.end))
    axes.grid(True, axis="y")
    for limit in panel.limits:
        axes.axhline(limit, **LIMIT)
    for which, clip in cell.clips.items():
        view = views[which]
        _saturation(axes, panel, which, view, clip)
        if panel.ranges is not None:
            _band(axes, view, panel.ranges[which], clip)
        for k, values in enumerate(panel.values[which].T):
            looks, entry = (RUNS, which) if panel.overlay else (LINES, k)
            # Noisy curves are solid, because the gaps of dashed lines would not be visible.
            look = looks[entry % len(looks)] | ({"linestyle": "-", "linewidth": 0.7} if panel.noisy else {})
            name = panel.names[entry] if panel.names else ""
            # Leave out NaN values, so that the curve is a straight line across gaps.
            inside = (view.t >= clip.begin) & (view.t <= clip.end) & np.isfinite(values)
            label = plot_label(name) if name else None
            axes.plot(clip.x(view.t[inside]), values[inside], label=label, **look)
            if panel.stopped is not None and panel.stopped[which][:, k].any():
                axes.plot(clip.x(view.t), np.where(panel.stopped[which][:, k], values, np.nan), **STOP)
    if panel.scale == "metric":
        _scale_metric(axes, panel.values)
    elif panel.scale == "from zero":
        axes.set_ylim(bottom=0.0)


def _saturation(axes: Any, panel: Panel, which: int, view: RunView, clip: Clip) -> None:
    """Mark the ticks with a command at a limit, because a single tick is too short to be seen."""
    for limit, flags in zip(panel.limits, panel.saturated(which), strict=True):
        times = view.t[flags & (view.t >= clip.begin) & (view.t <= clip.end)]
        # Draw at most one mark per interval of time, because closer marks would cover each other.
        places = np.floor(_BINS / 8 * (times - clip.begin) / (clip.end - clip.begin))
        seen = times[np.unique(places, return_index=True)[1]]
        axes.plot(clip.x(seen), np.full(len(seen), limit), **AT_LIMIT)


def _band(axes: Any, view: RunView, bounds: Array, clip: Clip) -> None:
    """Fill between the smallest lower bound and the largest upper bound in each bin of ticks."""
    inside = (view.t >= clip.begin) & (view.t <= clip.end)
    t, bounds = view.t[inside], bounds[inside]
    starts = np.arange(0, len(t), max(len(t) // _BINS, 1))
    low, high = np.minimum.reduceat(bounds[:, 0], starts), np.maximum.reduceat(bounds[:, 1], starts)
    axes.fill_between(clip.x(t[starts]), low, high, **BAND)


def _scale_metric(axes: Any, values: Sequence[Array]) -> None:
    """Make the axis of H logarithmic if H varies by more than a factor of 10; otherwise start it at zero."""
    every = np.concatenate([value[np.isfinite(value)] for value in values])
    if every.size and (every > 0).all() and spreads(every, 10.0):
        log_axis(axes)
        if not spreads(every, 100.0):
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    elif every.size:
        axes.set_ylim(min(0.0, 1.1 * float(every.min())), 1.1 * float(every.max()) or 1.0)
    else:
        axes.text(0.5, 0.5, "H was not evaluated", ha="center", va="center", transform=axes.transAxes, color=GRAY)


def _common_handles(views: Sequence[RunView], panels: Sequence[Panel]) -> list[Any]:
    words = {"impact": "impact window" if not views[0].pushed else "push", "dwell": "dwell"}
    kinds = {span.kind for view in views for span in view.windows}
    handles: list[Any] = [Patch(label=words[kind], **SHADES[kind]) for kind in words if kind in kinds]
    if any(panel.limits for panel in panels):
        handles.append(Line2D([], [], label="limit", **LIMIT))
    if any(flags.any() for panel in panels for k in range(len(views)) for flags in panel.saturated(k)):
        handles.append(Line2D([], [], label="command at a limit", **AT_LIMIT))
    if any(panel.ranges for panel in panels):
        handles.append(Patch(label="range of commands", **BAND))
    stopped = [flags for panel in panels if panel.stopped is not None for flags in panel.stopped]
    if any(flags.any() for flags in stopped):
        handles.append(Line2D([], [], label="joint at its stop", **STOP))
    return handles


def _legend(body: Any, shared: Sequence[Any], named: Sequence[tuple[str, Any]]) -> None:
    """Put the legend to the right of the panels, or below them if no curve has a name.

    ``shared`` are legend entries for all panels.  ``named`` are pairs of a heading and the axes with the curves below
    this heading.  The heading is omitted if only one of the axes has named curves.
    """
    groups = [(what, handles) for what, axes in named if (handles := axes.get_legend_handles_labels()[0])]
    if not groups:
        if shared:
            shared_legend(body, shared, "lower")
        return
    entries: list[Any] = [*groups[0][1], *shared] if len(groups) == 1 else []
    if not entries:
        for what, handles in [*groups, ("", shared)]:
            entries += [Line2D([], [], linestyle="", label=what or " "), *handles]
    body.legend(handles=entries, loc="outside right center", handlelength=2.6, fontsize=SMALL)
