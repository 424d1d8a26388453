"""Figure ``postures``: the links of the robot in both postures, with the contact planes and the normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from impact_posture.output.plot.ellipsoid_shapes import (
    COORDINATE_PLANES,
    XY,
    XZ,
    YZ,
    Plane,
    outline,
    square,
    upright_plane,
)
from impact_posture.output.plot.labels import Label, draw_arrow, draw_end_on
from impact_posture.output.plot.result_view import ResultView, contact_letters, header_lines
from impact_posture.output.plot.silhouette import NOTE, draw_silhouettes, silhouette_handles
from impact_posture.output.plot.skeleton import Skeleton, build_skeleton
from impact_posture.output.plot.space_axes import Space, frame_space
from impact_posture.output.plot.style import AFTER, BEFORE, BLUE, GRAY, INK, VERMILLION, framed, shared_legend
from impact_posture.system.arrays import Array

STICKS = "Sticks join joint origins."
_NO_SHAPES = "Sticks do not show the shapes of the links."
_ENDS = "The last stick of a chain ends at the last frame of its link, or at the center of mass of the link."
_NORMAL = "n points out of the surface, towards the robot."
_PUSHED = "n is the direction of the impulse on the robot, which strikes no surface."
_BEHIND = "If the contact link reaches beyond the contact point, the surface is drawn behind the link."
_BODY = "The box between the hips is the body; its height is not to scale."
HATCH = "/////"
# 3-D axes draw areas with a zorder of 3 or more.  This offset draws lines and markers in front of the areas.
_FRONT = 50.0


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """Contact plane, drawn as a square with an arrow for its normal.

    Attributes:
        point: Center of the square, shape (3,).
        normal: Unit normal, shape (3,).
        side: Side of the square, m.
        contact: Contact point, at which the arrow starts, shape (3,).
        reach: Length of the arrow, m.
        name: Letters next to the arrow.
        color: Color of the posture; gray for a plane that both postures share.
    """

    point: Array
    normal: Array
    side: float
    contact: Array
    reach: float
    name: str
    color: str

    @property
    def tip(self) -> Array:
        """Tip of the arrow, shape (3,)."""
        return np.asarray(self.contact + self.reach * self.normal)

    @property
    def ink(self) -> str:
        """Color of lines; black for a plane that both postures share."""
        return INK if self.color == GRAY else self.color

    def outline(self, plane: Plane) -> Array:
        """Return the corners of the hatched strip behind the contact plane in the side view, shape (4, 2)."""
        middle, n = plane.axes @ self.point, plane.axes @ self.normal
        along, deep = np.array([-n[1], n[0]]) * self.side / 2, -0.22 * self.side * n
        return np.array([middle + along, middle - along, middle - along + deep, middle + along + deep])


def postures_figure(view: ResultView) -> Figure:
    """Draw both postures in 3-D, and in a side view that shows n and most of the motion.

    A contact plane is a square in 3-D, and a hatched edge in the side view.  If the contact plane moves or turns, it
    is drawn for both postures.
    """
    first, second = (
        build_skeleton(view.robot, q, view.objective.contacts, view.objective.supports, collisions)
        for q, collisions in zip((view.q_initial, view.q_optimal), view.collisions, strict=True)
    )
    points = np.vstack([first.points, second.points])
    side = 0.3 * max(float(np.ptp(points, axis=0).max()), 1e-3)
    surfaces = surfaces_of(first, second, contact_letters(view), side, view.depths)
    plane = side_plane(first, second)
    states = ((first, BEFORE), (second, AFTER))
    normal = _PUSHED if view.pushed else _NORMAL
    notes = [*stick_notes(first), _ENDS, normal, *([_BEHIND] if any(view.depths) and not view.pushed else [])]
    low, high = _window([first, second], plane, surfaces)
    # The side view determines the height of the figure, within the limits of a page.
    height = float(np.clip(3.1 * (high - low)[1] / (high - low)[0], 2.3, 3.6)) + 1.0
    with framed(*header_lines(view), height, notes) as (figure, body):
        grid = body.add_gridspec(1, 2)
        space, flat = body.add_subplot(grid[0, 0], axes_class=Space), body.add_subplot(grid[0, 1])
        every = np.vstack([points, *[np.vstack([square(s.point, s.normal, s.side).T, s.tip]) for s in surfaces]])
        size, middle = np.ptp(every, axis=0), (every.min(axis=0) + every.max(axis=0)) / 2
        # The box must not be flat, even if the robot is planar.
        half = np.maximum(0.54 * size, 0.2 * float(size.max()))
        frame_space(space, middle - half, middle + half, "m", 5, azimuth=-60)
        for surface in surfaces:
            _plane_3d(space, surface, matter=not view.pushed)
            _plane_2d(flat, surface, plane, matter=not view.pushed)
        for state, line in states:
            draw_sticks(space, state, line, None)
            draw_sticks(flat, state, line, plane)
        frame_flat(flat, low, high, 6)
        flat.grid(True)
        flat.set(xlabel=f"{plane.right}  [m]", ylabel=f"{plane.up}  [m]", title="seen along " + depth_of(plane))
        shared_legend(body, _handles(first, second, [] if view.pushed else surfaces), "lower")
    return figure


def stick_notes(state: Skeleton) -> list[str]:
    """Return the sentences below the figure that explain sticks, shapes and body."""
    if state.hulls:
        return [STICKS, NOTE]
    return [f"{STICKS} {_NO_SHAPES}", *([_BODY] if len(state.body) else [])]


def side_plane(first: Skeleton, second: Skeleton) -> Plane:
    """Return the coordinate plane that contains n and shows most of the motion.

    If no coordinate plane contains n, return the upright plane through n.
    """
    n = second.normal
    candidates = [plane for plane in (XZ, YZ, XY) if plane.contains(n)]
    if not candidates:
        return upright_plane(n)
    motion = second.points - first.points
    size = second.points - second.points.mean(axis=0)
    # Exclude side views in which a planar robot would be a line.
    if second.across is not None:
        candidates = [plane for plane in candidates if not plane.contains(second.across)] or candidates

    def shown(plane: Plane) -> float:
        # If there is little motion, prefer the plane in which the robot appears larger.
        seen = float(np.linalg.norm(motion @ plane.axes.T) + 0.2 * np.linalg.norm(size @ plane.axes.T))
        # A view from above is harder to read, so it is used only if it shows much more motion.
        return seen / 2 if plane is XY else seen

    return max(candidates, key=shown)


def surfaces_of(
    first: Skeleton, second: Skeleton, letters: list[str], side: float, depths: Sequence[float] = ()
) -> list[DrawnSurface]:
    """Return the contact planes, ``depths`` (m) behind the contact points.

    A contact has two planes, one for each posture, if it moves along n or if n turns.
    """
    surfaces = []
    depths = depths or [0.0] * len(letters)
    pairs = zip(first.contacts, second.contacts, first.normals, second.normals, letters, depths, strict=True)
    for before, after, n_before, n_after, letter, depth in pairs:
        below, above = before - depth * n_before, after - depth * n_after
        step, turned = after - before, float(np.linalg.norm(n_before - n_after)) > 0.01
        if not turned and abs(float(step @ n_after)) < 0.03 * side:
            # The contact moved along the same surface, so draw the surface below both contact points.
            wide = side + float(np.linalg.norm(step))
            surfaces.append(DrawnSurface((below + above) / 2, n_after, wide, after, 0.8 * side, f"n{letter}", GRAY))
        else:
            surfaces.append(DrawnSurface(below, n_before, side, before, 0.8 * side, f"n₀{letter}", VERMILLION))
            surfaces.append(DrawnSurface(above, n_after, side, after, 0.8 * side, f"n₁{letter}", BLUE))
    return surfaces


def _window(states: list[Skeleton], plane: Plane, surfaces: list[DrawnSurface]) -> tuple[Array, Array]:
    """Return the lower left and upper right corner of the side view, shape (2,) each."""
    drawn = [plane.axes @ state.points.T for state in states]
    for s in surfaces:
        drawn += [s.outline(plane).T, plane.axes @ s.tip[:, None]]
    return padded(np.hstack(drawn).min(axis=1), np.hstack(drawn).max(axis=1))


def padded(low: Array, high: Array) -> tuple[Array, Array]:
    """Add a margin to a window with the corners ``low`` and ``high``.  Widen the window if it is too narrow."""
    longest = float((high - low).max()) or 1.0
    middle, half = (low + high) / 2, np.maximum(high - low, 0.6 * longest) / 2 + 0.05 * longest
    return middle - half, middle + half


def frame_flat(axes: Any, low: Array, high: Array, bins: int) -> None:
    """Give a panel the corners ``low`` and ``high``, shape (2,), equal axes and few ticks."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box")
    axes.locator_params(nbins=bins)


def depth_of(plane: Plane) -> str:
    """Return the direction in which the reader of a plane looks, as text."""
    if plane in COORDINATE_PLANES:
        return {"xz": "+y", "yz": "−x", "xy": "−z"}[plane.name]
    return "the horizontal across n"


def _draw(axes: Any, points: Array, plane: Plane | None, **look: Any) -> None:
    """Plot points of shape (3, k), projected onto ``plane``, or in 3-D if ``plane`` is ``None``."""
    if plane is None:
        look["zorder"] += _FRONT
    axes.plot(*(points if plane is None else plane.axes @ points), **look)


def _fill(axes: Any, faces: list[Array], plane: Plane | None, color: str, zorder: float) -> None:
    """Fill polygons of shape (3, k), projected onto ``plane``, or in 3-D if ``plane`` is ``None``."""
    look = {"facecolor": color, "alpha": 0.1, "linewidth": 0}
    if plane is None:
        axes.add_collection3d(Poly3DCollection([face.T for face in faces], **look))
        return
    for face in faces:
        axes.fill(*(plane.axes @ face), zorder=zorder, **look)


def draw_sticks(axes: Any, state: Skeleton, line: dict[str, Any], plane: Plane | None) -> None:
    """Draw sticks, shapes and marks of a robot, projected onto ``plane``, or in 3-D if ``plane`` is ``None``."""
    # A single line with gaps draws faster than a line for each stick.
    sticks = np.insert(state.bones, 2, np.nan, axis=1).reshape(-1, 3)
    _draw(axes, sticks.T, plane, solid_capstyle="round", **line)
    color, thin = line["color"], line | {"linewidth": 0.8, "zorder": 2.0}
    if state.hulls:
        draw_silhouettes(axes, state.hulls, color, plane)
    elif len(state.body):
        _body(axes, state.body, line, plane)
    for circle, arm in zip(state.rotors, state.arms, strict=True):
        _fill(axes, [circle], plane, color, 1.5)
        _draw(axes, np.hstack([circle, circle[:, :1]]), plane, **thin)
        # Arms are thinner than links, because they overlap in the side view.
        _draw(axes, arm.T, plane, **(thin | {"linestyle": "-"}))
    _draw(axes, state.joints.T, plane, linestyle="", marker="o", markersize=2.6, color=color, zorder=4)
    look = {"linestyle": "", "markeredgecolor": "white", "color": color}
    origin = np.asarray(state.base.translation)[:, None]
    _draw(axes, origin, plane, marker="P", markersize=7, markeredgewidth=0.6, zorder=5, **look)
    feet = {"linestyle": "", "marker": "^", "markersize": 6, "markerfacecolor": "white", "markeredgecolor": color}
    _draw(axes, state.feet.T, plane, zorder=5, **feet)
    _draw(axes, state.contacts.T, plane, marker="o", markersize=5.5, markeredgewidth=0.8, zorder=6, **look)


def _body(axes: Any, corners: Array, line: dict[str, Any], plane: Plane | None) -> None:
    if plane is not None:
        around = outline(plane.axes @ corners.T)
        axes.fill(*around, facecolor=line["color"], alpha=0.12, linewidth=0, zorder=1.5)
        axes.plot(*around, **(line | {"linewidth": 1.1}))
        return
    low, high = [0, 1, 2, 3], [4, 5, 6, 7]
    sides = [[k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k] for k in range(4)]
    _fill(axes, [corners[face].T for face in (low, high, *sides)], None, line["color"], 1.5)
    for edge in ([*low, 0], [*high, 4], *[[k, k + 4] for k in low]):
        axes.plot(*corners[edge].T, **(line | {"linewidth": 1.1}))


def _plane_3d(axes: Any, surface: DrawnSurface, *, matter: bool) -> None:
    if matter:
        corners = square(surface.point, surface.normal, surface.side)
        _fill(axes, [corners], None, surface.color, 1.0)
        axes.plot(*corners, color=surface.color, linewidth=0.8)
    n = surface.tip - surface.contact
    axes.quiver(*surface.contact, *n, color=surface.ink, linewidth=1.2, arrow_length_ratio=0.2)
    axes.add_artist(Label(surface.name, surface.tip, color=surface.ink))


def _plane_2d(axes: Any, surface: DrawnSurface, plane: Plane, *, matter: bool) -> None:
    if np.linalg.norm(plane.axes @ surface.normal) < 0.05:
        draw_end_on(axes, surface.name, plane, surface.normal, plane.axes @ surface.contact, surface.ink)
        return
    if matter:
        outline = surface.outline(plane)
        axes.fill(*outline.T, facecolor="none", edgecolor=surface.color, hatch=HATCH, linewidth=0, zorder=1)
        axes.plot(*outline[:2].T, color=surface.ink, linewidth=1.0, zorder=1)
    tip = plane.axes @ surface.tip
    draw_arrow(axes, plane.axes @ surface.contact, tip, 7, color=surface.ink, linewidth=1.2)
    axes.add_artist(Label(surface.name, tip, tuple(plane.axes @ surface.normal), surface.ink))


def robot_handles(state: Skeleton, lines: dict[str, dict[str, Any]], color: str) -> list[Any]:
    """Return the legend entries for ``lines`` (name → line style), and for base, contact points and feet."""
    marks: list[tuple[str, dict[str, Any]]] = [
        ("base", {"marker": "P", "markersize": 7}),
        ("contact point", {"marker": "o", "markersize": 5.5}),
    ]
    if len(state.feet):
        marks.append(("foot that stays", {"marker": "^", "markersize": 6, "markerfacecolor": "white"}))
    looks = [*lines.items(), *((word, {"linestyle": "", "color": color} | look) for word, look in marks)]
    return [Line2D([], [], label=word, **look) for word, look in looks]


def _handles(other: Skeleton, state: Skeleton, surfaces: list[DrawnSurface]) -> list[Any]:
    handles = robot_handles(state, {"before": BEFORE, "after": AFTER}, GRAY)
    for color, word in {GRAY: "surface", VERMILLION: "surface before", BLUE: "surface after"}.items():
        if any(s.color == color for s in surfaces):
            handles.append(Patch(facecolor="none", edgecolor=color, hatch=HATCH, linewidth=0, label=word))
    handles += silhouette_handles([*other.hulls, *state.hulls], BLUE)
    if len(state.body) and not state.hulls:
        handles.append(Patch(facecolor=BLUE, alpha=0.12, label="body"))
    if len(state.rotors):
        handles.append(Line2D([], [], color=BLUE, linewidth=0.8, label="rotors"))
    return handles
