"""Axes over time, for the pictures of runs: shaded windows, curves thinned to what can be seen, one legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator

from impact_posture.escape import plot_label
from impact_posture.plot.path_figure import log_axis, spreads
from impact_posture.plot.run_panels import LINES, Clip, Panel, first_impact, whole
from impact_posture.plot.run_view import RunView
from impact_posture.plot.shapes import Vector
from impact_posture.plot.style import GRAY, INK, shared_legend

# Pink and light gray: far enough apart in a gray print, too.
SHADES: dict[str, dict[str, Any]] = {
    "dwell": {"facecolor": "#f0f0f0", "edgecolor": "none", "zorder": 0.1},
    "impact": {"facecolor": "#edc3d6", "edgecolor": "none", "zorder": 0.2},
}
LIMIT: dict[str, Any] = {"color": INK, "linestyle": (0, (6, 3)), "linewidth": 0.8, "zorder": 1.5}
STOP: dict[str, Any] = {"color": INK, "linewidth": 3.6, "alpha": 0.35, "zorder": 2.0, "solid_capstyle": "butt"}
AT_LIMIT: dict[str, Any] = {
    "linestyle": "", "marker": "D", "markersize": 3.2, "color": INK, "markeredgecolor": "white",
    "markeredgewidth": 0.4, "zorder": 5,
}  # fmt: skip
BAND: dict[str, Any] = {"facecolor": "#dcdcdc", "edgecolor": "none", "zorder": 1.2}
# Points across a page's width; each shows the lowest and the highest value in it.
_BINS = 1000


def draw_panel(axes: Any, panel: Panel, which: int, view: RunView, clip: Clip) -> None:
    """Draw run ``which`` of a panel: shaded windows, limits, curves."""
    frame_time(axes, view, clip)
    for limit in panel.limits:
        axes.axhline(limit, **LIMIT)
    _saturation(axes, panel, which, view, clip)
    if panel.ranges is not None:
        _band(axes, view, panel.ranges[which], clip)
    for k, name in enumerate(panel.names):
        # Commands carry the sensors' noise: dashes of it are a blot.
        look = LINES[k % len(LINES)] | ({"linestyle": "-", "linewidth": 0.7} if panel.noisy else {})
        curve(axes, view, panel.values[which][:, k], clip, label=plot_label(name), **look)
        if panel.stopped is not None and panel.stopped[which][:, k].any():
            at_stop = np.where(panel.stopped[which][:, k], panel.values[which][:, k], np.nan)
            axes.plot(clip.x(view.t), at_stop, **STOP)


def frame_time(axes: Any, view: RunView, clip: Clip) -> None:
    """Shade the windows and set the axis of time."""
    shade(axes, view, clip)
    axes.set_xlim(clip.x(clip.begin), clip.x(clip.end))
    axes.grid(True, axis="y")


def shade(axes: Any, view: RunView, clip: Clip) -> None:
    """Shade the windows that begin or end within a clip; impacts over dwells."""
    for kind, look in SHADES.items():
        for span in view.windows:
            if span.kind == kind and span.end > clip.begin and span.begin < clip.end:
                axes.axvspan(clip.x(span.begin), clip.x(span.end), **look)


def curve(axes: Any, view: RunView, values: Vector, clip: Clip, **look: Any) -> None:
    """Draw a curve within a clip; where it has no values (NaN) it goes straight on."""
    inside = (view.t >= clip.begin) & (view.t <= clip.end) & np.isfinite(values)
    t, y = thin(view.t[inside], values[inside])
    axes.plot(clip.x(t), y, **look)


def _saturation(axes: Any, panel: Panel, which: int, view: RunView, clip: Clip) -> None:
    """Mark on a limit when a command was at it: a tick of a controller is too short to be seen."""
    for limit, flags in zip(panel.limits, panel.saturated(which), strict=True):
        times = view.t[flags & (view.t >= clip.begin) & (view.t <= clip.end)]
        # Not closer than can be seen.
        places = np.floor(_BINS / 8 * (times - clip.begin) / (clip.end - clip.begin))
        seen = times[np.unique(places, return_index=True)[1]]
        axes.plot(clip.x(seen), np.full(len(seen), limit), **AT_LIMIT)


def _band(axes: Any, view: RunView, bounds: Vector, clip: Clip) -> None:
    """Fill between the lower and the upper bound; of each bin of ticks the lowest and the highest."""
    inside = (view.t >= clip.begin) & (view.t <= clip.end)
    t, bounds = view.t[inside], bounds[inside]
    starts = np.arange(0, len(t), max(len(t) // _BINS, 1))
    low, high = np.minimum.reduceat(bounds[:, 0], starts), np.maximum.reduceat(bounds[:, 1], starts)
    axes.fill_between(clip.x(t[starts]), low, high, **BAND)


def thin(t: Vector, values: Vector) -> tuple[Vector, Vector]:
    """Keep of each bin of ticks the lowest and the highest value, both at their own times: no peak is lost."""
    step = len(t) // _BINS
    if step < 4:
        return t, values
    starts = np.arange(0, len(t), step)
    kept = {0, len(t) - 1}
    for start in starts:
        part = values[start : start + step]
        kept |= {int(start + part.argmin()), int(start + part.argmax())}
    order = np.array(sorted(kept))
    return t[order], values[order]


def scale_metric(axes: Any, values: Sequence[Vector]) -> None:
    """Make H's axis logarithmic where it spans more than a decade; else let it begin at zero."""
    every = np.concatenate([value[np.isfinite(value)] for value in values])
    if every.size and (every > 0).all() and spreads(every, 10.0):
        log_axis(axes)
        if not spreads(every, 100.0):
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    elif every.size:
        axes.set_ylim(min(0.0, 1.1 * float(every.min())), 1.1 * float(every.max()) or 1.0)
    else:
        axes.text(0.5, 0.5, "H was not evaluated", ha="center", va="center", transform=axes.transAxes, color=GRAY)


def common_handles(views: Sequence[RunView], panels: Sequence[Panel] = ()) -> list[Any]:
    """Legend entries of what all panels share: shades, limits, stops."""
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


def subplots(body: Any, rows: int, columns: int, **more: Any) -> Any:
    """Panels as an array of shape (rows, columns)."""
    return np.array(body.subplots(rows, columns, squeeze=False, **more))


def grid(body: Any, view: RunView, rows: int) -> tuple[Any, list[Clip]]:
    """Rows of panels: the whole run, wide, and beside it the first impact, where there is one; and their clips."""
    clips = [clip for clip in (whole(view), first_impact(view)) if clip is not None]
    ratios = [1.7, 1.0][: len(clips)]
    return subplots(body, rows, len(clips), sharey="row", sharex="col", width_ratios=ratios), clips


def name_time(panels: Any, clips: Sequence[Clip]) -> None:
    """Label a row of panels' axes of time."""
    for axes, clip in zip(panels, clips, strict=False):
        axes.set_xlabel(clip.label)


def share_height(panels: Sequence[Any]) -> None:
    """Give all panels the same upright limits, those of the widest."""
    low = min(axes.get_ylim()[0] for axes in panels)
    high = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(low, high)


def headed(rows: Sequence[Panel], axes: Sequence[Any]) -> list[tuple[str, Any]]:
    """For :func:`finish`: what each row's curves are, and a panel that has them."""
    return [(row.label.split("  [")[0] + ":", own) for row, own in zip(rows, axes, strict=False)]


def finish(body: Any, left: Sequence[Any], shared: Sequence[Any], named: Sequence[tuple[str, Any]] = ()) -> None:
    """Align the labels on the left, and put the one legend right of the panels, or below where no curve has a name.

    Args:
        body: The part of the figure that the panels are in.
        left: The panels at its left edge.
        shared: Legend entries of what all panels share.
        named: What curves are, and a panel that has them; as there are several kinds, each has its heading.
    """
    body.align_ylabels(left)
    groups = [(what, axes.get_legend_handles_labels()[0]) for what, axes in named]
    groups = [(what, handles) for what, handles in groups if handles]
    entries: list[Any] = []
    for what, handles in groups:
        entries += [_heading(what), *handles] if what and len(groups) > 1 else handles
    if entries:
        entries += [_heading(""), *shared] if len(groups) > 1 else shared
        body.legend(handles=entries, loc="outside right center", handlelength=2.6, fontsize=7)
    elif shared:
        shared_legend(body, shared, "lower")


def _heading(text: str) -> Line2D:
    return Line2D([], [], linestyle="", label=text or " ")
