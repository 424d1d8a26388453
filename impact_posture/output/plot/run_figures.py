"""Figures of runs over time: the metric, the commands and the joints, of a single run or of several controllers."""

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
    metric_panels,
    speed_panel,
    whole,
)
from impact_posture.output.plot.run_view import RunView, check_same
from impact_posture.output.plot.snapshots_figure import snapshots_figure
from impact_posture.system.escape import plot_label

HINT = "Less H is better: it is the squared velocity jump of an impulse of 1 N·s along n."
LEFT = "Left: the whole run. Right: the first impact."
# Controllers side by side.
COLUMNS = 3
# Widths of the whole run and of the first impact beside it.
_WIDTHS = (1.7, 1.0)


def figures_of_run(view: RunView) -> dict[str, Figure]:
    """Return the figures of a run by name: ``metric``, ``controls``, ``joints`` and ``snapshots``.

    A robot without actuators has no ``controls``, a robot without joints has no ``joints``.
    """
    figures = {"metric": metric_figure(view)}
    if control_panels([view]):
        figures["controls"] = controls_figure(view)
    if joint_panels([view]):
        figures["joints"] = joints_figure([view])
    return figures | {"snapshots": snapshots_figure([view])}


def figures_of_comparison(views: Sequence[RunView]) -> dict[str, Figure]:
    """Return the figures of several controllers in a scenario by name.

    They are ``comparison-metric``, ``comparison-controls``, ``comparison-joints`` and ``snapshots``.

    Args:
        views: A run of each controller (of a push: with the same sign). The nominal controller is drawn first.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    figures = {"comparison-metric": comparison_figure(views)}
    if control_panels(views):
        figures["comparison-controls"] = controls_comparison_figure(views)
    if joint_panels(views):
        figures["comparison-joints"] = joints_figure(views)
    return figures | {"snapshots": snapshots_figure(views)}


def metric_figure(view: RunView) -> Figure:
    """Draw H, ``‖ν‖``, the contact force, and the level of the impact-robust term where it changes, over time."""
    panels = metric_panels(view)
    cells = [_beside(panel, 0, view) for panel in panels]
    return time_figure([view], cells, 1.25, [HINT, *_notes(panels, cells)], widths=_WIDTHS)


def controls_figure(view: RunView) -> Figure:
    """Draw the rotor speeds and commanded joint torques of a run with actuators, and their limits (dashed)."""
    panels = control_panels([view])
    cells = [_beside(panel, 0, view) for panel in panels]
    return time_figure([view], cells, 1.9, _notes(panels, cells), widths=_WIDTHS)


def joints_figure(views: Sequence[RunView]) -> Figure:
    """Draw the joint positions with shaded windows, the controllers below each other (nominal first).

    The robot has joints of one degree of freedom.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    views = check_same(views, "figure joints")
    panels = joint_panels(views)
    cells = [_beside(panel, k, view) for k, view in enumerate(views) for panel in panels]
    columns = min(len(row) for row in cells)
    cells = [row[:columns] for row in cells]
    titles = {row: view.name for row, view in zip(range(0, len(cells), len(panels)), views, strict=True)}
    for row, name in titles.items() if len(views) > 1 else ():
        cells[row][0] = replace(cells[row][0], title=plot_label(name))
    notes, height = _notes(panels, cells), 1.6 if len(cells) > 1 else 2.6
    return time_figure(views, cells, height, notes, widths=_WIDTHS, title_at="left")


def comparison_figure(views: Sequence[RunView]) -> Figure:
    """Draw H over time of all controllers, and below it ``‖ν‖`` around the first impact.

    Below, and for pushes above, time counts from each controller's own impact.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    views = check_same(views, "figure comparison-metric")
    spans = [_since_impact(view) for view in views]
    names = [plot_label(view.name) for view in views]
    every = replace(
        spans[0],
        begin=spans[0].origin + min(span.begin - span.origin for span in spans),
        end=spans[0].origin + max(span.end - span.origin for span in spans),
    )
    values = [view.objective[:, None] for view in views]
    panel = replace(metric_panels(views[0])[0], names=names, values=values, overlay=True)
    # The shaded windows are those of the first run, on the axis of all.
    cells = [[Cell(panel, dict(enumerate(spans)), (0, every))]]
    notes, clips = [HINT], {k: clip for k, view in enumerate(views) if (clip := first_impact(view)) is not None}
    if len(clips) == len(views):
        longest = max(clips.items(), key=lambda item: item[1].end - item[1].begin)
        cells.append([Cell(speed_panel(views), clips, longest)])
        if not views[0].pushed:
            notes.append(f"Windows above: those of {names[0]}. Below, time counts from the own touch of each run.")
    return time_figure(views, cells, 2.3 if len(cells) > 1 else 2.6, notes, air=0.0)


def controls_comparison_figure(views: Sequence[RunView]) -> Figure:
    """Draw the commands around the impacts with their limits (dashed), a column for each controller, nominal left.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    views = check_same(views, "figure comparison-controls")
    panels = control_panels(views)
    columns = min(len(views), COLUMNS)
    cells: list[list[Cell | None]] = []
    for first in range(0, len(views), columns):
        block = list(enumerate(views))[first : first + columns]
        for panel in panels:
            titles = [plot_label(view.name) if panel is panels[0] else "" for _, view in block]
            row = [Cell.of(panel, k, impacts(view), title) for (k, view), title in zip(block, titles, strict=True)]
            cells.append([*row, *[None] * (columns - len(row))])
    return time_figure(views, cells, 1.7, _notes(panels, cells))


def _beside(panel: Panel, which: int, view: RunView) -> list[Cell]:
    """Cells of the whole run and, where there is an impact, of the first impact."""
    return [Cell.of(panel, which, clip) for clip in (whole(view), first_impact(view)) if clip is not None]


def _notes(panels: Sequence[Panel], cells: Sequence[Sequence[Cell | None]]) -> list[str]:
    """Notes of the panels, and what the columns are where the first impact stands beside the whole run."""
    left = any(cell is not None and cell.frame[1].scale != 1.0 for cell in cells[0])
    return [*dict.fromkeys(panel.note for panel in panels if panel.note), *[LEFT] * left]


def _since_impact(view: RunView) -> Clip:
    """Clip of a whole run; for a push in seconds from its begin, because runs wait for rest differently long."""
    clip = whole(view)
    if not (view.pushed and view.impacts):
        return clip
    return replace(clip, origin=view.impacts[0].begin, label="time since push  [s]")
