"""Pictures of a run over time: the metric, the commands, the joints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
    grid,
    headed,
    name_time,
    scale_metric,
    share_height,
    subplots,
)
from impact_posture.plot.run_panels import LINES, control_panels, first_impact, joint_panels, whole
from impact_posture.plot.run_view import RunView, check_same, run_header
from impact_posture.plot.style import DEFAULT_FORMATS, check_formats, framed, save, style
from impact_posture.plot.view import mixed_unit

METRIC = "H  [‖Δν‖²/(N·s)²]"
HINT = "Less H is better: it is the squared velocity jump of an impulse of 1 N·s along n."
LEFT = "Left: the whole run; right: the first impact."


def draw_run(view: RunView, out_dir: Path, formats: Iterable[str] = DEFAULT_FORMATS) -> list[Path]:
    """Write the pictures of one run, ``metric``, ``controls`` and ``joints``, into ``out_dir``; return the paths.

    Those that the robot has nothing for (no actuators, no joints) are left out.

    Raises:
        InputError: An unknown format.
        OutputError: The folder or a file cannot be written.
    """
    wanted = check_formats(formats)
    figures = {"metric": metric_figure(view)}
    if control_panels([view]):
        figures["controls"] = controls_figure(view)
    if joint_panels([view]):
        figures["joints"] = joints_figure([view])
    return [path for name, figure in figures.items() for path in save(figure, out_dir, name, wanted)]


def metric_figure(view: RunView) -> Figure:
    """Draw H, ``‖ν‖``, the contact's force, and the level of the term where it changes, over time."""
    unit = mixed_unit(view.robot)
    n = np.array(view.contact.normal)
    normal = view.force @ n
    across = np.linalg.norm(view.force - normal[:, None] * n, axis=1)
    force = [(normal, "", LINES[0])] if view.pushed else [(view.peak, "force: normal, peak", LINES[0])]
    if not view.pushed:
        force.append((across, "force: friction", LINES[1]))
    rows: list[tuple[str, list[tuple[Any, str, dict[str, Any]]]]] = [
        (METRIC, [(view.objective, "", LINES[0])]),
        (f"‖ν‖  [{unit.strip('()')}]", [(view.speed, "", LINES[0])]),
        ("push  [N]" if view.pushed else "force  [N]", force),
    ]
    if np.ptp(view.level) > 1e-9:
        rows.append(("level of\nthe term  [1]", [(view.level, "", LINES[0])]))
    notes = [HINT] if view.pushed else [HINT, "Normal: the largest within each tick of the controller."]
    notes = [" ".join([*notes, *([LEFT] if view.impacts else [])])]
    with style():
        figure, body = framed(*run_header([view]), 1.25 * len(rows) + 0.75, notes)
        panels, clips = grid(body, view, len(rows))
        for axes_row, (label, curves) in zip(panels, rows, strict=True):
            for axes, clip in zip(axes_row, clips, strict=True):
                frame_time(axes, view, clip)
                for values, name, look in curves:
                    curve(axes, view, values, clip, label=name or None, **look)
            axes_row[0].set_ylabel(label)
        for axes in panels[0]:
            scale_metric(axes, [view.objective])
        name_time(panels[-1], clips)
        finish(body, list(panels[:, 0]), common_handles([view]), [("", panels[2, 0])])
    return figure


def controls_figure(view: RunView) -> Figure:
    """Draw the rotor speeds and commanded joint torques of a run, which has some, with their limits (dashed)."""
    rows = control_panels([view])
    notes = [" ".join([*[panel.note for panel in rows if panel.note], LEFT * bool(view.impacts)])]
    with style():
        figure, body = framed(*run_header([view]), 1.9 * len(rows) + 0.75, notes)
        panels, clips = grid(body, view, len(rows))
        for axes_row, panel in zip(panels, rows, strict=True):
            for axes, clip in zip(axes_row, clips, strict=True):
                draw_panel(axes, panel, 0, view, clip)
            axes_row[0].set_ylabel(panel.label)
        name_time(panels[-1], clips)
        finish(body, list(panels[:, 0]), common_handles([view], rows), headed(rows, panels[:, 0]))
    return figure


def joints_figure(views: Sequence[RunView]) -> Figure:
    """Draw the joints' positions with shaded windows, the controllers one below the other (nominal first).

    The robot has joints of one degree of freedom.

    Raises:
        InputError: No view, or views of different scenarios or robots.
    """
    views = check_same(views, "figure joints")
    rows = joint_panels(views)
    clips = [[clip for clip in (whole(view), first_impact(view)) if clip is not None] for view in views]
    columns = min(len(pair) for pair in clips)
    notes = " ".join([*dict.fromkeys(panel.note for panel in rows if panel.note), LEFT * (columns == 2)])
    with style():
        count = len(views) * len(rows)
        figure, body = framed(*run_header(views), (1.6 if count > 1 else 2.6) * count + 0.75, [notes])
        panels = subplots(body, count, columns, sharey="row", width_ratios=[1.7, 1.0][:columns])
        for index, axes_row in enumerate(panels):
            panel, which = rows[index % len(rows)], index // len(rows)
            for axes, clip in zip(axes_row, clips[which], strict=False):
                draw_panel(axes, panel, which, views[which], clip)
            axes_row[0].set_ylabel(panel.label)
            if len(views) > 1:
                axes_row[0].set_title(plot_label(views[which].name), loc="left", fontweight="bold")
            if panel is rows[-1]:
                name_time(axes_row, clips[which])
            else:
                for axes in axes_row:
                    axes.tick_params(labelbottom=False)
        finish(body, list(panels[:, 0]), common_handles(views, rows), headed(rows, panels[:, 0]))
        for k in range(len(rows)):
            share_height(list(panels[k :: len(rows)].flat))
    return figure
