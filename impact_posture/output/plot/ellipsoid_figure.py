"""Figure ``ellipsoid``: the impact ellipsoid Λ_c at the start and the optimum, projected onto planes and in 3-D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case.worst_normal import WorstNormal
from impact_posture.output.plot.ellipsoid_shapes import (
    COORDINATE_PLANES,
    Plane,
    cone_rim,
    cone_shadow,
    half_width,
    longest,
    principal_sections,
    shadow,
    square,
    surface,
    upright_plane,
)
from impact_posture.output.plot.labels import Label, draw_arrow, draw_end_on
from impact_posture.output.plot.result_view import ResultView, header_lines, jump_unit, number
from impact_posture.output.plot.space_axes import Space, frame_space
from impact_posture.output.plot.style import (
    AFTER,
    BEFORE,
    BLUE,
    FREE_AFTER,
    FREE_BEFORE,
    GRAY,
    INK,
    PALE,
    SMALL,
    WORST_AFTER,
    WORST_BEFORE,
    framed,
)
from impact_posture.system.arrays import Array

# Length of arrows and of the drawn cone, as a share of the limit of the panel.
REACH = 0.92
_FREE = "Free (thin): the same robot with feet that are not held."
_CONE = "The objective is the value for the worst normal of the cone. All equally bad normals are drawn."
NOTES = (
    "The half-width of Λ$_c$ along any direction is the size ‖Δν‖ of the velocity jump that an impulse of 1 N·s "
    "along it causes. Planes show shadows (projections), not slices; √H is the distance of the tangent planes along "
    "n, not the ellipsoid's radius there.",
)


@dataclass(frozen=True, eq=False)
class _State:
    """Ellipsoid to draw, with its name and line style; if ``free`` is true, the ellipsoid without supports."""

    word: str
    at: ImpactQuantities
    line: dict[str, Any]
    free: bool = False


def ellipsoid_figure(view: ResultView) -> Figure:
    """Draw Λ_c at the start (dashed) and at the optimum (solid), projected onto planes and in 3-D, with √H along n.

    The planes are the coordinate planes.  If no coordinate plane contains n, the upright plane through n is added.
    Projections onto planes that contain n have tangent lines at ±√H.  All panels have the same scale, equal in all
    directions.  Thin lines show the ellipsoids without support feet.  For an uncertain normal, the figure shows the
    cone of normals and the worst normals.
    """
    states = [_State("before", view.before, BEFORE), _State("after", view.after, AFTER)]
    for word, free, line in zip(("before", "after"), view.free, (FREE_BEFORE, FREE_AFTER), strict=False):
        states.append(_State(f"{word}, free", free, line, free=True))
    unit = f"{jump_unit(view)}/(N·s)"
    limit = 1.18 * max(longest(state.at.ellipsoid) for state in states) or 1.0
    n = view.after.normal
    notes = [*NOTES, *([_FREE] if view.objective.supports else []), *([_CONE] if _cones(view) else [])]
    with framed(*header_lines(view), 5.8, notes) as (figure, body):
        grid = body.add_gridspec(2, 3, height_ratios=[1, 1.4])
        oblique = not any(plane.contains(n) for plane in COORDINATE_PLANES)
        panels = [(grid[0, column], plane) for column, plane in enumerate(COORDINATE_PLANES)]
        panels += [(grid[1, 0], upright_plane(n))] if oblique else []
        for spot, plane in panels:
            axes = body.add_subplot(spot)
            _panel(axes, plane, states, limit, unit)
            draw_uncertainty(axes, plane, view, limit)
            draw_normals(axes, plane, normals(view.before, view.after), limit)
        space = body.add_subplot(grid[1, 1] if oblique else grid[1, :2], axes_class=Space)
        _space(space, states, limit, unit)
        draw_uncertainty_3d(space, view, limit)
        _legend(body.add_subplot(grid[1, 2]), states, unit, view)
    return figure


def square_panel(axes: Any, plane: Plane, limit: float, unit: str) -> None:
    """Give a panel equal axes from ``-limit`` to ``limit``, faint lines through zero, and labels with the unit."""
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_aspect("equal", adjustable="box")
    axes.locator_params(nbins=5)
    axes.axhline(0.0, color=PALE, linewidth=0.6, zorder=0)
    axes.axvline(0.0, color=PALE, linewidth=0.6, zorder=0)
    axes.set_xlabel(f"{plane.right}  [{unit}]")
    axes.set_ylabel(f"{plane.up}  [{unit}]", labelpad=1)
    axes.set_title(f"shadow on {plane.name}")


def draw_normals(axes: Any, plane: Plane, named: list[tuple[str, Array]], limit: float) -> None:
    """Draw the projection of each normal as an arrow, or as a dot (out of the page) or a cross (into the page)."""
    for name, n in named:
        flat = plane.axes @ n
        if np.linalg.norm(flat) < 0.05:
            draw_end_on(axes, name, plane, n, np.zeros(2))
            continue
        tip = flat * limit * REACH
        draw_arrow(axes, np.zeros(2), tip, 5, color=INK, linewidth=1.1)
        axes.add_artist(Label(name, tip, (flat[0], flat[1])))


def _panel(axes: Any, plane: Plane, states: list[_State], limit: float, unit: str) -> None:
    square_panel(axes, plane, limit, unit)
    for state in states:
        axes.plot(*shadow(state.at.ellipsoid, plane.axes), solid_joinstyle="round", **state.line)
        if plane.contains(state.at.normal) and not state.free:
            _tangents(axes, plane, state, limit)


def _tangents(axes: Any, plane: Plane, state: _State, limit: float) -> None:
    flat = plane.axes @ state.at.normal
    flat = flat / np.linalg.norm(flat)
    along = np.array([-flat[1], flat[0]]) * 3 * limit
    width = half_width(state.at.ellipsoid, state.at.normal)
    look = {"color": state.line["color"], "linestyle": state.line["linestyle"], "linewidth": 0.7, "zorder": 2}
    for sign in (1, -1):
        axes.plot(*np.array([sign * width * flat - along, sign * width * flat + along]).T, **look)


def normals(before: ImpactQuantities, after: ImpactQuantities) -> list[tuple[str, Array]]:
    """Return the name and the direction of n; two normals if n turns with the contact frame."""
    if np.linalg.norm(before.normal - after.normal) < 1e-3:
        return [("n", after.normal)]
    return [("n₀", before.normal), ("n₁", after.normal)]


def normal_label(named: list[tuple[str, Array]]) -> str:
    """Return the legend entry for the normals from :func:`normals`."""
    return "n, out of the surface" if len(named) == 1 else "n₀ before, n₁ after"


def _space(axes: Any, states: list[_State], limit: float, unit: str) -> None:
    frame_space(axes, np.full(3, -limit), np.full(3, limit), unit, 4, azimuth=-55)
    axes.plot_surface(
        *surface(states[1].at.ellipsoid), color=BLUE, alpha=0.12, shade=False, linewidth=0, antialiased=True
    )
    for state in states:
        for section in principal_sections(state.at.ellipsoid):
            axes.plot(*section, **(state.line | {"linewidth": 0.7 if state.free else 1.0}))
        width, n = half_width(state.at.ellipsoid, state.at.normal), state.at.normal
        for sign in () if state.free else (1, -1):
            axes.plot(*square(sign * width * n, n, 0.7 * limit), **(state.line | {"linewidth": 0.7}))
    for name, n in normals(states[0].at, states[1].at):
        axes.plot(*np.outer(n, [-limit, limit]), color=GRAY, linewidth=0.6)
        axes.quiver(0, 0, 0, *(n * limit), color=INK, linewidth=1.1, arrow_length_ratio=0.12)
        axes.add_artist(Label(name, n * limit))
    axes.set_title("Λ$_c$ and its tangent planes along n")


def _legend(axes: Any, states: list[_State], unit: str, view: ResultView) -> None:
    axes.set_axis_off()
    named = normals(view.before, view.after)
    handles = []
    for state in states:
        width = half_width(state.at.ellipsoid, state.at.normal)
        handles.append(Line2D([], [], label=f"{state.word}:  √H = {number(width)}", **state.line))
    handles.append(Line2D([], [], color=GRAY, linewidth=0.7, label="tangents at ±√H along n"))
    handles.append(Line2D([], [], color=INK, linewidth=1.1, label=normal_label(named)))
    handles += uncertainty_handles(view)
    legend = axes.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.0, 1.0), borderpad=0, handlelength=2.6, labelspacing=0.4
    )
    rows = [f"semi-axes of Λ$_c$  [{unit}]"]
    for state in states:
        radii = np.sqrt(np.maximum(np.linalg.eigvalsh(state.at.ellipsoid)[::-1], 0.0))
        largest = max(float(radii[0]), 1e-300)
        rows.append(f"{state.word}  " + "  ".join(number(r if r > 1e-7 * largest else 0.0) for r in radii))
    # The semi-axes are written relative to the legend, so they are always below the legend.
    look = {"xycoords": legend, "textcoords": "offset points", "va": "top", "fontsize": SMALL, "linespacing": 1.4}
    axes.annotate("\n".join(rows), (0, 0), (0, -8), **look)


def draw_uncertainty(axes: Any, plane: Plane, view: ResultView, limit: float) -> None:
    """Draw the projected cone of normals and the worst normals.  If n turns, draw a cone for each posture."""
    for n in _cones(view):
        outline = cone_shadow(n, view.objective.normal_cone_deg, REACH * limit, plane.axes)
        axes.fill(*outline, facecolor=PALE, edgecolor="none", alpha=0.55, zorder=0.5)
        axes.plot(*outline, color=GRAY, linewidth=0.6, zorder=0.6)
    for word, worst, _, line in _worst(view):
        for normal in worst.normals:
            # Dashed lines are on top, so solid lines below them stay visible.
            zorder = 4.6 if word == "before" else 4.5
            draw_arrow(axes, np.zeros(2), plane.axes @ normal * REACH * limit, zorder, mutation_scale=8, **line)


def draw_uncertainty_3d(axes: Any, view: ResultView, limit: float) -> None:
    """Draw the cone of normals and the worst normals in 3-D."""
    for n in _cones(view):
        rim = cone_rim(n, view.objective.normal_cone_deg, limit, 49)
        sheet = [row[None] * [[0.0], [1.0]] for row in rim]
        axes.plot_surface(*sheet, color=GRAY, alpha=0.15, shade=False, linewidth=0)
        axes.plot(*rim, color=GRAY, linewidth=0.6)
    for _, worst, _, line in _worst(view):
        for normal in worst.normals:
            axes.quiver(0, 0, 0, *(normal * limit), arrow_length_ratio=0.12, **line)


def uncertainty_handles(view: ResultView) -> list[Any]:
    """Return legend entries for the cone and for the worst normals, with the jump per impulse along each."""
    if not _cones(view):
        return []
    cone = f"cone of {view.objective.normal_cone_deg:g}° about n"
    handles: list[Any] = [Patch(facecolor=PALE, edgecolor=GRAY, linewidth=0.6, label=cone)]
    for word, worst, ellipsoid, line in _worst(view):
        tied = f", {len(worst.normals)} tied" if worst.tied else ""
        jump = number(half_width(ellipsoid, worst.normal))
        label = f"worst {word}: {number(worst.angle_deg)}° off{tied},\njump {jump} per N·s"
        handles.append(Line2D([], [], label=label, **line))
    return handles


def _cones(view: ResultView) -> list[Array]:
    """Return the axes of the cones of normals, world, as :func:`normals` does; empty without a cone."""
    return [n for _, n in normals(view.before, view.after)] if view.objective.normal_cone_deg > 0 else []


def _worst(view: ResultView) -> list[tuple[str, WorstNormal, Array, dict[str, Any]]]:
    """Return name, worst normals, ellipsoid and line style for each posture that has worst normals."""
    states = zip(("before", "after"), view.worst, (view.before, view.after), (WORST_BEFORE, WORST_AFTER), strict=True)
    return [(word, worst, at.ellipsoid, line) for word, worst, at, line in states if worst is not None]
