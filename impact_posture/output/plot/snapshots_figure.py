"""Figure ``snapshots``: the robot at three times of a run, in a row for each controller."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impact_posture.output.plot.ellipsoid_shapes import Plane
from impact_posture.output.plot.labels import draw_arrow
from impact_posture.output.plot.postures_figure import (
    HATCH,
    depth_of,
    draw_sticks,
    frame_flat,
    padded,
    robot_handles,
    side_plane,
    stick_notes,
)
from impact_posture.output.plot.run_view import RunView, check_same, run_header
from impact_posture.output.plot.silhouette import silhouette_handles
from impact_posture.output.plot.skeleton import Skeleton, build_skeleton
from impact_posture.output.plot.style import BLUE, GRAY, INK, PALE, START, TEXT, VERMILLION, framed, shared_legend
from impact_posture.system.arrays import Array
from impact_posture.system.escape import plot_label

_START_NOTE = "Gray sticks show the robot at the start of the run."
_NOW: dict[str, Any] = {"color": BLUE, "linestyle": "-", "linewidth": 1.5, "zorder": 3.0}
# Line styles of the arrow before a push and during a push.
_PUSH: dict[int, dict[str, Any]] = {1: {"linestyle": (0, (2, 1.5)), "linewidth": 1.2}, 2: {"linewidth": 1.8}}
# Time from the snapshot before the impact to the impact, s.  The tick of the snapshot must not contain the impact.
_BEFORE = 0.005


def instants(view: RunView) -> list[tuple[str, float]]:
    """Return the names and times (s) of three snapshots: start, just before the first impact, and end of its window.

    Without an impact, the snapshots are at the start, the middle and the end of the run.
    """
    start = ("start", float(view.t[0]))
    if not view.impacts:
        return [start, ("half of the run", float(view.t[len(view.t) // 2])), ("end", float(view.t[-1]))]
    first = view.impacts[0]
    word = "push" if view.pushed else "impact window"
    return [start, ("just before the first impact", first.begin - _BEFORE), (f"end of the {word}", first.end)]


def snapshots_figure(views: Sequence[RunView]) -> Figure:
    """Draw a side view of the robot that shows n and most of the motion, with the surface or the push (arrow).

    All panels have the same scale.
    """
    views = check_same(views, "figure snapshots")
    rows = [
        [build_skeleton(v.robot, v.q[v.index(time)], [v.contact], v.supports) for _, time in instants(v)]
        for v in views
    ]
    plane = side_plane(rows[-1][0], rows[-1][1])
    every = np.hstack([plane.axes @ state.points.T for row in rows for state in row])
    low, high = every.min(axis=1), every.max(axis=1)
    reach = 0.22 * float((high - low).max())
    arrows = [_arrow(view, plane, reach) for view in views]
    for arrow, row in zip(arrows, rows, strict=True):
        if arrow is not None:
            tips = np.array([plane.axes @ state.contact for state in row[1:]])
            ends = np.vstack([tips, tips - arrow])
            low, high = np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))
    low, high = _window(low, high, views[0], plane)
    # The robot determines the height of the panels, within the limits of a page.
    highest = float(np.clip(8.5 / len(views), 1.2, 3.0))
    height = float(np.clip(2.1 * (high - low)[1] / (high - low)[0], 1.2, highest)) + 0.2
    notes = [*stick_notes(rows[0][0]), _START_NOTE]
    with framed(*run_header(views), height * len(views) + 0.85, notes) as (figure, body):
        panels = body.subplots(len(views), 3, squeeze=False, sharex=True, sharey=True)
        for axes_row, row, view, arrow in zip(panels, rows, views, arrows, strict=True):
            for column, (axes, state, (word, time)) in enumerate(zip(axes_row, row, instants(view), strict=True)):
                _surface(axes, view, plane, low, high)
                if column:
                    draw_sticks(axes, row[0], START, plane)
                draw_sticks(axes, state, _NOW, plane)
                if arrow is not None and column:
                    contact = plane.axes @ state.contact
                    draw_arrow(axes, contact - arrow, contact, 7, color=VERMILLION, shrinkB=3, **_PUSH[column])
                frame_flat(axes, low, high, 5)
                first = f"{word}\n" * (view is views[0])
                axes.set_title(f"{first}t = {max(time, 0.0):.2f} s", fontsize=TEXT)
            axes_row[0].set_ylabel(f"{plot_label(view.name)}\n{plane.up}  [m]")
        for axes in panels[-1]:
            axes.set_xlabel(f"{plane.right}  [m]")
        panels[-1][1].set_xlabel(f"{plane.right}  [m]\nseen along {depth_of(plane)}")
        shared_legend(body, _handles(rows[0][0], views[0]), "lower")
    return figure


def _window(low: Array, high: Array, view: RunView, plane: Plane) -> tuple[Array, Array]:
    """Return the corners of a panel that shows all sticks and, unless the surface faces the reader, the surface."""
    if view.surface is not None:
        touched = plane.axes @ view.surface
        n = plane.axes @ np.array(view.contact.normal)
        # The surface extends without limit, so the panel must be larger only along its normal.
        edge = touched - 0.05 * float((high - low).max()) * n
        for axis in range(2):
            if abs(n[axis]) > 0.5:
                low[axis], high[axis] = min(low[axis], edge[axis]), max(high[axis], edge[axis])
    return padded(low, high)


def _surface(axes: Any, view: RunView, plane: Plane, low: Array, high: Array) -> None:
    n = plane.axes @ np.array(view.contact.normal)
    if view.surface is None or np.linalg.norm(n) < 1e-6:
        return
    n = n / np.linalg.norm(n)
    size = 2 * float((high - low).max())
    point, along = plane.axes @ view.surface, size * np.array([-n[1], n[0]])
    # Move the reference point along the surface to the middle of the panel.
    point = point + along * float(along @ ((low + high) / 2 - point)) / size**2
    corners = np.array([point + along, point - along, point - along - size * n, point + along - size * n])
    axes.fill(*corners.T, facecolor="white", edgecolor=GRAY, hatch=HATCH, linewidth=0, zorder=0.5)
    axes.plot(*corners[:2].T, color=INK, linewidth=1.0, zorder=1)


def _arrow(view: RunView, plane: Plane, reach: float) -> Array | None:
    """Return the arrow of the push as a vector of length ``reach``, shape (2,); ``None`` without a push."""
    largest = view.force[int(np.argmax(np.linalg.norm(view.force, axis=1)))]
    size = float(np.linalg.norm(largest))
    if not view.pushed or size == 0:
        return None
    return np.asarray(plane.axes @ largest / size * reach)


def _handles(state: Skeleton, view: RunView) -> list[Any]:
    handles = [*robot_handles(state, {"now": _NOW, "start": START}, BLUE), *silhouette_handles(state.hulls, BLUE)]
    if view.surface is not None:
        return [*handles, Patch(facecolor=PALE, edgecolor=GRAY, hatch=HATCH, linewidth=0, label="surface")]
    arrow: dict[str, Any] = {"linestyle": "", "marker": r"$\rightarrow$", "markersize": 11, "color": VERMILLION}
    return [*handles, Line2D([], [], label="push (dashed: to come)", **arrow)]
