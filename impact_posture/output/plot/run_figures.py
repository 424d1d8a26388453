"""Figures of runs over time: metric, commands and joints, for one run or for several controllers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from matplotlib.figure import Figure

from impact_posture.output.plot.run_axes import Cell, time_figure
from impact_posture.output.plot.run_panels import (
    Clip,
    Panel,
    control_panels,
    first_impact,
    impacts,
    joint_panels,
    metric_panel,
    metric_panels,
    speed_panel,
    whole,
)
from impact_posture.output.plot.run_view import RunView, check_same
from impact_posture.output.plot.snapshots_figure import snapshots_figure
from impact_posture.system.escape import plot_label

HINT = "Less H is better: it is the squared velocity jump of an impulse of 1 N·s along n."
LEFT = "Left: the whole run. Right: the first impact."
# Largest number of controllers side by side.
COLUMNS = 3
# Relative widths of two columns: the whole run, and the first impact.
_WIDTHS = (1.7, 1.0)


def figures_of_run(view: RunView) -> dict[str, Figure]:
    """Return the figures of a run by name: ``metric``, ``controls``, ``joints`` and ``snapshots``.

    ``controls`` is missing if the robot has no actuators, and ``joints`` is missing if it has no joints.
    """
    figures = {"metric": metric_figure(view)}
    if control_panels([view]):
        figures["controls"] = controls_figure(view)
    if joint_panels([view]):
        figures["joints"] = joints_figure([view])
    return figures | {"snapshots": snapshots_figure([view])}


def figures_of_comparison(views: Sequence[RunView]) -> dict[str, Figure]:
    """Return the figures ``comparison-metric``, ``-controls``, ``-joints`` and ``snapshots`` of several controllers.

    ``views`` contains one run of each controller.  Pushes must have the same sign.
    """
    figures = {"comparison-metric": comparison_figure(views)}
    if control_panels(views):
        figures["comparison-controls"] = controls_comparison_figure(views)
    if joint_panels(views):
        figures["comparison-joints"] = joints_figure(views)
    return figures | {"snapshots": snapshots_figure(views)}


def metric_figure(view: RunView) -> Figure:
    """Draw H, ``‖ν‖``, the contact force, and the activation of the impact-robust term if it changes, over time."""
    panels = metric_panels(view)
    cells = [_run_and_impact(panel, 0, view) for panel in panels]
    return time_figure([view], cells, 1.25, [HINT, *_notes(panels, cells)], widths=_WIDTHS)


def controls_figure(view: RunView) -> Figure:
    """Draw rotor speeds and commanded joint torques with their limits (dashed) over time."""
    panels = control_panels([view])
    cells = [_run_and_impact(panel, 0, view) for panel in panels]
    return time_figure([view], cells, 1.9, _notes(panels, cells), widths=_WIDTHS)


def joints_figure(views: Sequence[RunView]) -> Figure:
    """Draw the positions of joints with one degree of freedom over time, with a row for each controller."""
    views = check_same(views, "figure joints")
    panels = joint_panels(views)
    cells = [_run_and_impact(panel, k, view) for k, view in enumerate(views) for panel in panels]
    columns = min(len(row) for row in cells)
    cells = [row[:columns] for row in cells]
    for k, view in enumerate(views if len(views) > 1 else ()):
        row = cells[k * len(panels)]
        row[0] = replace(row[0], title=plot_label(view.name))
    notes, height = _notes(panels, cells), 1.6 if len(cells) > 1 else 2.6
    return time_figure(views, cells, height, notes, widths=_WIDTHS, title_at="left")


def comparison_figure(views: Sequence[RunView]) -> Figure:
    """Draw H of all controllers over time, and below it ``‖ν‖`` around the first impact.

    In the lower panel, time zero is the first impact of each run.  For pushes, the upper panel has the same time
    axis.
    """
    views = check_same(views, "figure comparison-metric")
    spans = [_since_impact(view) for view in views]
    names = [plot_label(view.name) for view in views]
    origin = spans[0].origin
    begin = origin + min(span.begin - span.origin for span in spans)
    end = origin + max(span.end - span.origin for span in spans)
    # The axis shows all runs, and the shaded windows belong to the first run.
    frame = (0, replace(spans[0], begin=begin, end=end))
    cells = [[Cell(metric_panel(views, names), dict(enumerate(spans)), frame)]]
    notes, clips = [HINT], {k: clip for k, view in enumerate(views) if (clip := first_impact(view)) is not None}
    if len(clips) == len(views):
        longest = max(clips.items(), key=lambda item: item[1].end - item[1].begin)
        cells.append([Cell(speed_panel(views), clips, longest)])
        if not views[0].pushed:
            notes.append(f"Shaded above: windows of {names[0]}. Time zero below: the first touch of each run.")
    return time_figure(views, cells, 2.3 if len(cells) > 1 else 2.6, notes, air=0.0)


def controls_comparison_figure(views: Sequence[RunView]) -> Figure:
    """Draw the commands around the impacts with their limits (dashed), in a column for each controller."""
    views = check_same(views, "figure comparison-controls")
    panels = control_panels(views)
    columns = min(len(views), COLUMNS)
    cells: list[list[Cell | None]] = []
    for first in range(0, len(views), columns):
        block = range(first, min(first + columns, len(views)))
        for panel in panels:
            titles = {k: plot_label(views[k].name) if panel is panels[0] else "" for k in block}
            row = [Cell.of(panel, k, impacts(views[k]), titles[k]) for k in block]
            cells.append([*row, *[None] * (columns - len(row))])
    return time_figure(views, cells, 1.7, _notes(panels, cells))


def _run_and_impact(panel: Panel, which: int, view: RunView) -> list[Cell]:
    return [Cell.of(panel, which, clip) for clip in (whole(view), first_impact(view)) if clip is not None]


def _notes(panels: Sequence[Panel], cells: Sequence[Sequence[Cell | None]]) -> list[str]:
    left = any(cell is not None and cell.frame[1].scale != 1.0 for cell in cells[0])
    return [*dict.fromkeys(panel.note for panel in panels if panel.note), *[LEFT] * left]


def _since_impact(view: RunView) -> Clip:
    """Return the clip of a whole run.  Time zero is the push, because runs differ in the time before the push."""
    clip = whole(view)
    if not (view.pushed and view.impacts):
        return clip
    return replace(clip, origin=view.impacts[0].begin, label="time since push  [s]")
