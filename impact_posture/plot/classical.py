"""Figure ``classical``: the velocity and force ellipsoids beside the impact ellipsoid, each in its own scale."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from impact_posture.plot.ellipsoid import draw_normal, normals, square_panel
from impact_posture.plot.shapes import COORDINATE_PLANES, Plane, Vector, polar, shadow
from impact_posture.plot.style import AFTER, BEFORE, INK, framed, style
from impact_posture.plot.view import ResultView

NOTES = (
    "Each row is divided by the longest semi-axis before (of those that end). Velocity J Jᵀ: contact velocities of "
    "joint velocities of norm 1. Force (J Jᵀ)⁻¹: contact forces of joint torques of norm 1 (unbounded where J is "
    "singular). Both know nothing of inertia or of supports; impact Λ$_c$ = J M⁻¹ W M⁻¹ Jᵀ does.",
)


def classical_figure(view: ResultView) -> Figure:
    """Draw the shadows of ``JJᵀ``, ``(JJᵀ)⁻¹`` and ``Λ_c`` before and after on the three coordinate planes.

    Where ``JJᵀ`` is singular the force ellipsoid has no end in some direction: it runs off the panel, which says so.
    """
    products = [J @ J.T for J in (view.jacobian(view.q_initial), view.jacobian(view.q_optimal))]
    impact = [view.before.ellipsoid, view.after.ellipsoid]
    with style():
        figure, body = framed(view, 6.6, NOTES)
        panels = body.subplots(3, 3)
        _row(panels[0], "velocity  J Jᵀ", products, view)
        _row(panels[1], "force  (J Jᵀ)⁻¹", products, view, dual=True)
        _row(panels[2], "impact  Λ$_c$", impact, view)
        body.legend(
            handles=[
                Line2D([], [], label="before", **BEFORE),
                Line2D([], [], label="after", **AFTER),
                Line2D([], [], label="n", color=INK, linewidth=1.1),
            ],
            loc="outside upper center",
            ncols=3,
        )
    return figure


def _row(panels: Any, name: str, matrices: list[Vector], view: ResultView, *, dual: bool = False) -> None:
    endless = [np.zeros((3, 0))] * 2
    if dual:
        finite = [polar(matrix, 0.0)[0] for matrix in matrices]
        reach = 1e3 * (_longest(finite[0]) or _longest(finite[1]) or 1.0)
        matrices, endless = map(list, zip(*(polar(matrix, reach) for matrix in matrices), strict=True))
    else:
        finite = matrices
    scale = _longest(finite[0]) or _longest(finite[1]) or 1.0
    limit = 1.18 * max(_longest(matrix) for matrix in finite) / scale or 1.18
    for axes, plane in zip(panels, COORDINATE_PLANES, strict=True):
        square_panel(axes, plane, limit, "")
        axes.set_title(f"{name},  shadow on {plane.name}", fontsize=8)
        for matrix, line in zip(matrices, (BEFORE, AFTER), strict=True):
            axes.plot(*shadow(matrix / scale**2, plane.axes, 721 if dual else 181), **line)
        for word, n in normals(view.before, view.after):
            draw_normal(axes, plane, n, limit, word)
        words = _unbounded(plane, endless)
        if words:
            axes.set_xlabel(f"{plane.right}\n{words}")


def _longest(matrix: Vector) -> float:
    return float(np.sqrt(max(float(np.linalg.eigvalsh(matrix)[-1]), 0.0)))


def _unbounded(plane: Plane, endless: list[Vector]) -> str:
    """Which of the two force ellipsoids has no end in the plane, in words."""
    lines = []
    for word, directions in zip(("before", "after"), endless, strict=True):
        seen = np.linalg.svd(plane.axes @ directions, compute_uv=False) if directions.shape[1] else np.zeros(0)
        rank = int((seen > 1e-6).sum())
        if rank:
            lines.append(f"{word}: unbounded, " + ("fills the plane" if rank == 2 else "a strip"))
    return "\n".join(lines)
