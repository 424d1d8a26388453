"""Figure ``ellipsoid``: the dynamic impact ellipsoid Λ_c before and after, as shadows and in space."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from impact_posture.impact.oracle import ImpactQuantities
from impact_posture.plot.shapes import (
    COORDINATE_PLANES,
    Plane,
    Vector,
    half_width,
    principal_sections,
    shadow,
    square,
    surface,
    upright_plane,
)
from impact_posture.plot.style import AFTER, BEFORE, BLUE, GRAY, INK, framed, style
from impact_posture.plot.view import ResultView, jump_unit, number

NOTES = (
    "The half-width of Λ$_c$ along any direction is the size ‖Δν‖ of the velocity jump that an impulse of 1 N·s "
    "along it causes. Planes show shadows (projections), not slices; √H is the distance of the tangent planes along "
    "n, not the ellipsoid's radius there.",
)


def ellipsoid_figure(view: ResultView) -> Figure:
    """Draw Λ_c before (dashed) and after (solid): shadows on the coordinate planes, and in 3-D with √H along n.

    A shadow on a plane that contains n has its tangent lines at ±√H drawn; where no coordinate plane contains n, the
    upright plane through n is added.  Equal axes; all panels share one scale.
    """
    states = ((view.before, BEFORE), (view.after, AFTER))
    unit = f"{jump_unit(view)}/(N·s)"
    limit = common_limit([state.ellipsoid for state, _ in states])
    n = view.after.normal
    with style():
        figure, body = framed(view, 5.5, NOTES)
        grid = body.add_gridspec(2, 3, height_ratios=[1, 1.2])
        for column, plane in enumerate(COORDINATE_PLANES):
            _panel(body.add_subplot(grid[0, column]), plane, states, limit, unit)
        oblique = not any(plane.contains(n) for plane in COORDINATE_PLANES)
        if oblique:
            _panel(body.add_subplot(grid[1, 0]), upright_plane(n), states, limit, unit)
        spot = grid[1, 1] if oblique else grid[1, :2]
        _space(body.add_subplot(spot, projection="3d"), states, limit, unit)
        _legend(body.add_subplot(grid[1, 2]), states, unit)
    return figure


def common_limit(matrices: list[Vector]) -> float:
    """Half the side of a cube in which all the ellipsoids lie, with some air; 1 if they are all points."""
    widest = max(float(np.linalg.eigvalsh(matrix)[-1]) for matrix in matrices)
    return 1.18 * float(np.sqrt(widest)) if widest > 0 else 1.0


def square_panel(axes: Any, plane: Plane, limit: float, unit: str) -> None:
    """Make a panel with equal axes from ``-limit`` to ``limit``, a faint cross and labels with the unit."""
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_aspect("equal", adjustable="box")
    axes.locator_params(nbins=5)
    axes.axhline(0.0, color="#d9d9d9", linewidth=0.6, zorder=0)
    axes.axvline(0.0, color="#d9d9d9", linewidth=0.6, zorder=0)
    suffix = f"  [{unit}]" if unit else ""
    axes.set_xlabel(f"{plane.right}{suffix}")
    axes.set_ylabel(f"{plane.up}{suffix}", labelpad=1)
    axes.set_title(f"shadow on {plane.name}")


def draw_normal(axes: Any, plane: Plane, n: Vector, limit: float, name: str = "n") -> None:
    """Draw n's projection as an arrow, or a dot (towards the reader) or cross (away) where it has none."""
    flat = plane.axes @ n
    toward = float(np.cross(plane.axes[0], plane.axes[1]) @ n)
    if np.linalg.norm(flat) < 0.05:
        axes.plot(0, 0, "o", markersize=8, markerfacecolor="white", markeredgecolor=INK, markeredgewidth=1, zorder=5)
        axes.plot(0, 0, "." if toward > 0 else "x", markersize=4, color=INK, zorder=6)
        axes.annotate(name, (0, 0), (6, 5), textcoords="offset points", fontstyle="italic", zorder=6)
        return
    tip = flat * limit * 0.92
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tuple(tip), (0, 0), arrowprops=arrow, zorder=5)
    # The name beside the shaft: above a lying one, right of a standing one (left where it leans to the right edge).
    lying = abs(flat[0]) > abs(flat[1])
    right = tip[0] < 0.5 * limit
    shift = (0, 4) if lying else (5 if right else -5, 0)
    look = {"ha": "center" if lying else ("left" if right else "right"), "va": "bottom" if lying else "center"}
    # A long name needs more of the shaft.
    at = tip * ((0.85 if len(name) == 1 else 0.6) if lying else 0.88)
    axes.annotate(name, tuple(at), shift, textcoords="offset points", fontstyle="italic", zorder=6, **look)


def _panel(axes: Any, plane: Plane, states: Any, limit: float, unit: str) -> None:
    square_panel(axes, plane, limit, unit)
    for state, line in states:
        axes.plot(*shadow(state.ellipsoid, plane.axes), solid_joinstyle="round", **line)
        if plane.contains(state.normal):
            _tangents(axes, plane, state, line, limit)
    for name, n in normals(states[0][0], states[1][0]):
        draw_normal(axes, plane, n, limit, name)


def _tangents(axes: Any, plane: Plane, state: ImpactQuantities, line: dict[str, Any], limit: float) -> None:
    """The two lines on which the shadow ends along n."""
    flat = plane.axes @ state.normal
    flat = flat / np.linalg.norm(flat)
    along = np.array([-flat[1], flat[0]]) * 3 * limit
    width = half_width(state.ellipsoid, state.normal)
    for sign in (1, -1):
        ends = np.array([sign * width * flat - along, sign * width * flat + along])
        axes.plot(ends[:, 0], ends[:, 1], color=line["color"], linestyle=line["linestyle"], linewidth=0.7, zorder=2)


def normals(before: ImpactQuantities, after: ImpactQuantities) -> list[tuple[str, Vector]]:
    """Name and direction of n: one, or two where it turned with the contact frame."""
    if np.linalg.norm(before.normal - after.normal) < 1e-3:
        return [("n", after.normal)]
    return [("n before", before.normal), ("n after", after.normal)]


def _space(axes: Any, states: Any, limit: float, unit: str) -> None:
    set_cube(axes, limit)
    for (state, line), fill in zip(states, (None, BLUE), strict=True):
        if fill is not None:
            axes.plot_surface(
                *surface(state.ellipsoid), color=fill, alpha=0.12, shade=False, linewidth=0, antialiased=True
            )
        for section in principal_sections(state.ellipsoid):
            axes.plot(*section, **(line | {"linewidth": 1.0}))
        width = half_width(state.ellipsoid, state.normal)
        for sign in (1, -1):
            corners = square(sign * width * state.normal, state.normal, 0.7 * limit)
            axes.plot(*corners, **(line | {"linewidth": 0.7}))
    for name, n in normals(states[0][0], states[1][0]):
        axes.plot(*np.outer(n, [-limit, limit]), color=GRAY, linewidth=0.6)
        axes.quiver(0, 0, 0, *(n * limit), color=INK, linewidth=1.1, arrow_length_ratio=0.12)
        beyond = 1.12 if len(name) == 1 else 1.35
        axes.text(*(n * limit * beyond), name, fontstyle="italic", ha="center", va="center")
    axes.set_title(f"Λ$_c$ and its tangent planes along n\n[{unit}]")


def set_cube(axes: Any, limit: float) -> None:
    """Equal 3-D axes from ``-limit`` to ``limit`` with few ticks."""
    for name in "xyz":
        getattr(axes, f"set_{name}lim")(-limit, limit)
        getattr(axes, f"set_{name}label")(name, labelpad=-6)
        axes.tick_params(axis=name, pad=0 if name == "z" else -2, labelsize=6.5)
        axes.locator_params(axis=name, nbins=4)
    axes.set_box_aspect((1, 1, 1), zoom=1.1)
    axes.view_init(elev=22, azim=-55)


def _legend(axes: Any, states: Any, unit: str) -> None:
    axes.set_axis_off()
    handles = []
    for word, (state, line) in zip(("before", "after"), states, strict=True):
        width = half_width(state.ellipsoid, state.normal)
        handles.append(Line2D([], [], label=f"{word}:  √H = {number(width)}", **line))
    handles.append(Line2D([], [], color=GRAY, linewidth=0.7, label="tangents at ±√H along n"))
    handles.append(Line2D([], [], color=INK, linewidth=1.1, label="n, out of the surface"))
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.06, 0.95), borderpad=0, handlelength=2.6)
    rows = ["semi-axes of Λ$_c$", f"[{unit}]"]
    for word, (state, _) in zip(("before", "after  "), states, strict=True):
        radii = np.sqrt(np.maximum(np.linalg.eigvalsh(state.ellipsoid)[::-1], 0.0))
        largest = max(float(radii[0]), 1e-300)
        rows.append(f"{word}  " + "   ".join(number(r if r > 1e-7 * largest else 0.0) for r in radii))
    axes.text(0.08, 0.48, "\n".join(rows), transform=axes.transAxes, va="top", fontsize=7.5, linespacing=1.4)
