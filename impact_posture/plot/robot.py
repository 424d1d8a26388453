"""Figure ``postures``: the robot's links in both postures, with the contact plane and the normal."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impact_posture.plot.shapes import COORDINATE_PLANES, XY, XZ, YZ, Plane, Vector, square, upright_plane
from impact_posture.plot.skeleton import Skeleton, build_skeleton
from impact_posture.plot.style import AFTER, BEFORE, BLUE, GRAY, INK, PALE, PLATE, VERMILLION, framed, style
from impact_posture.plot.view import ResultView, header_lines

NOTES = (
    "Sticks join joint origins and the last frame of each link (its center of mass where it has no other frame); "
    "they are not the links' shapes. n points out of the surface, towards the robot.",
)
# The letter n, legible over sticks.
_LETTER: dict[str, Any] = {"fontstyle": "italic", "ha": "center", "va": "center"}


def postures_figure(view: ResultView) -> Figure:
    """Draw both postures in the same axes: in 3-D, and from the side that shows n and most of the motion.

    Equal axes in meters; the contact plane as a square (from the side: an edge with hatched matter below it), feet
    and rotors where there are any.
    """
    first, second = (
        build_skeleton(view.robot, q, view.objective.contact, view.objective.supports)
        for q in (view.q_initial, view.q_optimal)
    )
    points = np.vstack([first.points, second.points])
    side = max(float(np.ptp(points, axis=0).max()), 1e-3)
    patch = 0.3 * side
    plane = side_plane(first, second)
    states = ((first, BEFORE | {"color": VERMILLION}), (second, AFTER))
    with style():
        surfaces = _surfaces(first, second, side)
        low, high = _window([first, second], plane, surfaces, patch)
        # As high as the view from the side needs, within a page's reason.
        height = float(np.clip(3.1 * (high - low)[1] / (high - low)[0], 2.3, 3.6)) + 1.0
        figure, body = framed(*header_lines(view), height, NOTES)
        # The empty column keeps the 3-D axes' labels, which the layout does not know of, off the others.
        grid = body.add_gridspec(1, 3, width_ratios=[1, 0.06, 1])
        space = body.add_subplot(grid[0, 0], projection="3d")
        flat = body.add_subplot(grid[0, 2])
        corners = [square(s.contact, s.normal, patch).T for s in surfaces]
        arrows = [(s.contact + patch * s.normal)[None] for s in surfaces]
        _box(space, np.vstack([points, *corners, *arrows]))
        turned = float(np.linalg.norm(first.normal - second.normal)) > 0.01
        for state in surfaces:
            named = turned or state is second
            _plane_3d(space, state, patch, named)
            _plane_2d(flat, state, plane, patch, named)
        for state, line in states:
            draw_sticks(space, state, line, None)
            draw_sticks(flat, state, line, plane)
        _frame_2d(flat, plane, low, high)
        look = {"ncols": 7, "handlelength": 2.2, "columnspacing": 1.4}
        body.legend(handles=_handles(second), loc="outside lower center", **look)
    return figure


def side_plane(first: Skeleton, second: Skeleton) -> Plane:
    """The coordinate plane that contains n and shows most of the motion; else the upright plane of n."""
    n = second.normal
    candidates = [plane for plane in (XZ, YZ, XY) if plane.contains(n)]
    if not candidates:
        return upright_plane(n)
    motion = second.points - first.points
    size = second.points - second.points.mean(axis=0)

    def shown(plane: Plane) -> float:
        # The robot's own spread decides where the motion does not.
        seen = float(np.linalg.norm(motion @ plane.axes.T) + 1e-3 * np.linalg.norm(size @ plane.axes.T))
        # A plan is harder to read than an elevation: it has to show much more.
        return seen / 2 if plane is XY else seen

    return max(candidates, key=shown)


def _surfaces(first: Skeleton, second: Skeleton, side: float) -> list[Skeleton]:
    """The postures whose contact planes differ: one if the contact stays where it is."""
    moved = float(np.linalg.norm(first.contact - second.contact)) > 0.01 * side
    turned = float(np.linalg.norm(first.normal - second.normal)) > 0.01
    return [first, second] if moved or turned else [second]


def _box(axes: Any, points: Vector) -> None:
    """Equal 3-D axes around the points: a box whose edges have the lengths that they show."""
    low, high = points.min(axis=0), points.max(axis=0)
    # A planar robot's box keeps some depth.
    half = np.maximum(0.54 * (high - low), 0.2 * float((high - low).max()))
    for name, middle, reach in zip("xyz", (low + high) / 2, half, strict=True):
        getattr(axes, f"set_{name}lim")(middle - reach, middle + reach)
        getattr(axes, f"set_{name}label")(f"{name} [m]", labelpad=-5)
        axes.tick_params(axis=name, pad=0 if name == "z" else -2, labelsize=6.5)
        axes.locator_params(axis=name, nbins=max(2, round(5 * float(reach / half.max()))))
    axes.set_box_aspect(tuple(half))
    axes.view_init(elev=20, azim=-60)


def _window(states: list[Skeleton], plane: Plane, surfaces: list[Skeleton], patch: float) -> tuple[Vector, Vector]:
    """Lower left and upper right corner of what the side view shows: everything drawn, with a margin."""
    drawn = [plane.axes @ state.points.T for state in states]
    for s in surfaces:
        drawn += [_outline(s, plane, patch).T, plane.axes @ (s.contact + patch * s.normal)[:, None]]
    low, high = np.hstack(drawn).min(axis=1), np.hstack(drawn).max(axis=1)
    # Never a narrow strip: the shorter side shows at least 0.6 of the longer.
    longest = float((high - low).max())
    middle, half = (low + high) / 2, np.maximum(high - low, 0.6 * longest) / 2 + 0.05 * longest
    return middle - half, middle + half


def _outline(state: Skeleton, plane: Plane, patch: float) -> Vector:
    """Corners of the strip of matter below the contact plane as seen from the side, shape (4, 2)."""
    contact, n = plane.axes @ state.contact, plane.axes @ state.normal
    along, deep = np.array([-n[1], n[0]]) * patch / 2, -0.25 * patch * n
    return np.array([contact + along, contact - along, contact - along + deep, contact + along + deep])


def _frame_2d(axes: Any, plane: Plane, low: Vector, high: Vector) -> None:
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="box")
    axes.grid(True)
    axes.locator_params(nbins=6)
    axes.set_xlabel(f"{plane.right} [m]")
    axes.set_ylabel(f"{plane.up} [m]")
    axes.set_title("seen along " + depth_of(plane))


def depth_of(plane: Plane) -> str:
    """The direction that a reader of the plane looks in."""
    if plane in COORDINATE_PLANES:
        return {"xz": "+y", "yz": "−x", "xy": "−z"}[plane.name]
    return "the horizontal across n"


def _draw(axes: Any, points: Vector, plane: Plane | None, **look: Any) -> None:
    """Plot points of shape (3, k), projected where there is a plane."""
    axes.plot(*(points if plane is None else plane.axes @ points), **look)


def draw_sticks(axes: Any, state: Skeleton, line: dict[str, Any], plane: Plane | None) -> None:
    """Draw bones, rotors, joints, base, feet and the contact point; in 3-D, or projected where there is a plane."""
    for bone in state.bones:
        _draw(axes, bone.T, plane, solid_capstyle="round", **line)
    color = line["color"]
    for circle in state.rotors:
        closed = np.hstack([circle, circle[:, :1]])
        _draw(axes, closed, plane, **(line | {"linewidth": 0.7, "zorder": 2.0}))
    _draw(axes, state.joints.T, plane, linestyle="", marker="o", markersize=2.6, color=color, zorder=4)
    _cross(axes, state, color, plane)
    feet = {"linestyle": "", "marker": "^", "markersize": 6, "markerfacecolor": "white", "markeredgecolor": color}
    _draw(axes, state.feet.T, plane, zorder=5, **feet)
    _draw(axes, state.contact[:, None], plane, linestyle="", marker="o", markersize=5.5, color=color,
          markeredgecolor="white", markeredgewidth=0.8, zorder=6)  # fmt: skip


def _cross(axes: Any, state: Skeleton, color: str, plane: Plane | None) -> None:
    origin = np.asarray(state.base.translation)[:, None]
    _draw(axes, origin, plane, linestyle="", marker="P", markersize=7, color=color, markeredgecolor="white",
          markeredgewidth=0.6, zorder=5)  # fmt: skip


def _plane_3d(axes: Any, state: Skeleton, patch: float, named: bool) -> None:
    corners = square(state.contact, state.normal, patch)
    grid = np.array([[corners[:, 0], corners[:, 1]], [corners[:, 3], corners[:, 2]]]).transpose(2, 0, 1)
    axes.plot_surface(*grid, color=GRAY, alpha=0.25, shade=False, linewidth=0)
    axes.plot(*corners, color=GRAY, linewidth=0.7)
    if not named:
        return
    axes.quiver(*state.contact, *(0.8 * patch * state.normal), color=INK, linewidth=1.2, arrow_length_ratio=0.2)
    axes.text(*(state.contact + 0.97 * patch * state.normal), "n", bbox=PLATE, **_LETTER)


def _plane_2d(axes: Any, state: Skeleton, plane: Plane, patch: float, named: bool) -> None:
    contact, n = plane.axes @ state.contact, plane.axes @ state.normal
    outline = _outline(state, plane, patch)
    axes.fill(outline[:, 0], outline[:, 1], facecolor="white", edgecolor=GRAY, hatch="/////", linewidth=0, zorder=1)
    axes.plot(*outline[:2].T, color=INK, linewidth=1.0, zorder=1)
    if not named:
        return
    tip = contact + 0.8 * patch * n
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tuple(tip), tuple(contact), arrowprops=arrow, zorder=7)
    axes.text(*(contact + 0.93 * patch * n), "n", bbox=PLATE, zorder=7, **_LETTER)


def _handles(state: Skeleton) -> list[Any]:
    def mark(label: str, marker: str, **look: Any) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, color=GRAY, label=label, **look)

    handles: list[Any] = [
        Line2D([], [], label="before", **BEFORE),
        Line2D([], [], label="after", **AFTER),
        mark("base", "P", markersize=7),
        mark("contact point", "o", markersize=5.5),
        Patch(facecolor=PALE, edgecolor=GRAY, hatch="/////", linewidth=0, label="surface"),
    ]
    if len(state.feet):
        handles.append(mark("foot that stays", "^", markersize=6, markerfacecolor="white"))
    if len(state.rotors):
        handles.append(Line2D([], [], color=BLUE, linewidth=0.7, label="rotors"))
    return handles
