"""Cone of an uncertain normal and its worst normals, as shadows and in 3-D."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impact_posture.arrays import Array
from impact_posture.impact.cone import WorstNormal
from impact_posture.plot.labels import draw_arrow
from impact_posture.plot.shapes import Plane, cone_rim, cone_shadow, half_width
from impact_posture.plot.style import GRAY, PALE, WORST_AFTER, WORST_BEFORE
from impact_posture.plot.view import ResultView, number

# Length of arrows as a part of the limit of the panel. A worst normal on the edge of the cone ends on the rim.
REACH = 0.92


def has_cone(view: ResultView) -> bool:
    """Return whether the normal is uncertain."""
    return view.objective.normal_cone_deg > 0


def draw_uncertainty(axes: Any, plane: Plane, view: ResultView, limit: float) -> None:
    """Draw the shadow of the cone (two cones where n turned) and the worst normals before and after."""
    for n in _axes_of_cones(view):
        outline = cone_shadow(n, view.objective.normal_cone_deg, REACH * limit, plane.axes)
        axes.fill(*outline, facecolor=PALE, edgecolor="none", alpha=0.55, zorder=0.5)
        axes.plot(*outline, color=GRAY, linewidth=0.6, zorder=0.6)
    for word, found, _, line in _worst(view):
        for normal in found.normals:
            # The dashes lie on top, as with the ellipsoids.
            zorder = 4.6 if word == "before" else 4.5
            draw_arrow(axes, np.zeros(2), plane.axes @ normal * REACH * limit, zorder, mutation_scale=8, **line)


def draw_uncertainty_3d(axes: Any, view: ResultView, limit: float) -> None:
    """Draw the surface and rim of the cone, and the worst normals."""
    for n in _axes_of_cones(view):
        rim = cone_rim(n, view.objective.normal_cone_deg, limit, 49)
        sheet = [row[None] * [[0.0], [1.0]] for row in rim]
        axes.plot_surface(*sheet, color=GRAY, alpha=0.15, shade=False, linewidth=0)
        axes.plot(*rim, color=GRAY, linewidth=0.6)
    for _, found, _, line in _worst(view):
        for normal in found.normals:
            axes.quiver(0, 0, 0, *(normal * limit), arrow_length_ratio=0.12, **line)


def uncertainty_handles(view: ResultView) -> list[Any]:
    """Return the legend entries of the cone and of the worst normals with the half-width of Λ_c along them."""
    if not has_cone(view):
        return []
    cone = f"cone of {view.objective.normal_cone_deg:g}° about n"
    handles: list[Any] = [Patch(facecolor=PALE, edgecolor=GRAY, linewidth=0.6, label=cone)]
    for word, found, ellipsoid, line in _worst(view):
        width = number(half_width(ellipsoid, found.normal))
        tied = f", {len(found.normals)} tied" if found.tied else ""
        label = f"worst {word}: {number(found.angle_deg)}° off{tied},\njump {width} per N·s"
        handles.append(Line2D([], [], label=label, **line))
    return handles


def _axes_of_cones(view: ResultView) -> list[Array]:
    """Return the world axis of the cone, or both axes where it turned with the contact frame; none without a cone."""
    if not has_cone(view):
        return []
    before, after = view.before.normal, view.after.normal
    return [after] if abs(before - after).max() < 1e-3 else [before, after]


def _worst(view: ResultView) -> list[tuple[str, WorstNormal, Array, dict[str, Any]]]:
    """Return name, worst normals, ellipsoid and line of each posture that has worst normals."""
    found = [
        ("before", view.worst[0], view.before.ellipsoid, WORST_BEFORE),
        ("after", view.worst[1], view.after.ellipsoid, WORST_AFTER),
    ]
    return [(word, worst, ellipsoid, line) for word, worst, ellipsoid, line in found if worst is not None]
