"""Pictures of several controllers in one scenario, side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from impact_posture.escape import plot_label
from impact_posture.plot.run_axes import (
    common_handles,
    curve,
    draw_panel,
    finish,
    frame_time,
    headed,
    scale_metric,
    shade,
    share_height,
    subplots,
)
from impact_posture.plot.run_figures import HINT, METRIC, joints_figure
from impact_posture.plot.run_panels import RUNS, Clip, control_panels, first_impact, impacts, joint_panels, whole
from impact_posture.plot.run_view import RunView, check_same, run_header
from impact_posture.plot.style import DEFAULT_FORMATS, check_formats, framed, save, style
from impact_posture.plot.view import mixed_unit

# Columns of controllers side by side.
COLUMNS = 3


def draw_comparison(views: Sequence[RunView], out_dir: Path, formats: Iterable[str] = DEFAULT_FORMATS) -> list[Path]:
    """Write the pictures of several controllers in one scenario; return the paths.

    ``comparison-metric``, ``comparison-controls`` and ``comparison-joints``.

    Args:
        views: One run of each controller (of a push: with the same sign); the nominal one is drawn first.
        out_dir: Folder, made if missing; files of the same name are replaced.
        formats: Of ``png``, ``svg`` and ``pdf``.

    Raises:
        InputError: No view, views of different scenarios or robots, an unknown format.
        OutputError: The folder or a file cannot be written.
    """
    wanted = check_formats(formats)
    figures = {"comparison-metric": comparison_figure(views)}
    if control_panels(views):
        figures["comparison-controls"] = controls_comparison_figure(views)
    if joint_panels(views):
        figures["comparison-joints"] = joints_figure(views)
    return [path for name, figure in figures.items() for path in save(figure, out_dir, name, wanted)]


def comparison_figure(views: Sequence[RunView]) -> Figure:
    """Draw H over time of all controllers, and below it ``‖ν‖`` around the first impact.

    Below, and for pushes above, time counts from each controller's own impact.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    views = check_same(views, "figure comparison-metric")
    hit = all(view.impacts for view in views)
    notes = HINT
    if hit and not views[0].pushed:
        notes += (
            f" Windows above: those of {plot_label(views[0].name)}. Below, time counts from each one's own touch."
        )
    spans = [_since_impact(view) for view in views]
    span = Clip(
        min(one.begin - one.origin for one in spans), max(one.end - one.origin for one in spans), label=spans[0].label
    )
    with style():
        figure, body = framed(*run_header(views), 4.6 if hit else 2.6, [notes])
        panels = subplots(body, 2 if hit else 1, 1)[:, 0]
        # What is shaded is the first one's, on the axis of all.
        shade(panels[0], views[0], spans[0])
        for view, own, look in zip(views, spans, cycle(RUNS), strict=False):
            curve(panels[0], view, view.objective, own, label=plot_label(view.name), **look)
        panels[0].set_xlim(span.begin, span.end)
        panels[0].grid(True, axis="y")
        scale_metric(panels[0], [view.objective for view in views])
        panels[0].set_ylabel(METRIC)
        panels[0].set_xlabel(span.label)
        if hit:
            _impact_panel(panels[1], views)
        finish(body, list(panels), common_handles(views), [("", panels[0])])
    return figure


def _since_impact(view: RunView) -> Clip:
    """All of a run; of a push in seconds from its begin, as runs wait for rest differently long."""
    all_of_it = whole(view)
    if not (view.pushed and view.impacts):
        return all_of_it
    return replace(all_of_it, origin=view.impacts[0].begin, label="time since push  [s]")


def _impact_panel(axes: Any, views: Sequence[RunView]) -> None:
    """``‖ν‖`` of all controllers around their first impact."""
    clips = [clip for clip in map(first_impact, views) if clip is not None]
    longest = max(clips, key=lambda clip: clip.end - clip.begin)
    frame_time(axes, views[clips.index(longest)], longest)
    for view, clip, look in zip(views, clips, cycle(RUNS), strict=False):
        curve(axes, view, view.speed, clip, **look)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel(f"‖ν‖  [{mixed_unit(views[0].robot).strip('()')}]")
    axes.set_xlabel(longest.label)


def controls_comparison_figure(views: Sequence[RunView]) -> Figure:
    """Draw the commands around the impacts with their limits (dashed): a column for each controller, nominal left.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    views = check_same(views, "figure comparison-controls")
    rows = control_panels(views)
    columns = min(len(views), COLUMNS)
    blocks = -(-len(views) // columns)
    notes = [" ".join(panel.note for panel in rows if panel.note)]
    with style():
        count = blocks * len(rows)
        figure, body = framed(*run_header(views), 1.7 * count + 0.75, notes)
        panels = subplots(body, count, columns)
        for row, column in np.ndindex(*panels.shape):
            axes, panel, which = panels[row, column], rows[row % len(rows)], row // len(rows) * columns + column
            if which >= len(views):
                # Stays as a place for the legend.
                axes.set_axis_off()
                continue
            draw_panel(axes, panel, which, views[which], impacts(views[which]))
            if row % len(rows) == 0:
                axes.set_title(plot_label(views[which].name), fontweight="bold")
            if row % len(rows) == len(rows) - 1:
                axes.set_xlabel(impacts(views[which]).label)
            else:
                axes.tick_params(labelbottom=False)
            if column == 0:
                axes.set_ylabel(panel.label)
            else:
                axes.tick_params(labelleft=False)
        for k in range(len(rows)):
            share_height([axes for axes in panels[k :: len(rows)].flat if axes.axison])
        finish(body, list(panels[:, 0]), common_handles(views, rows), headed(rows, panels[:, 0]))
    return figure
