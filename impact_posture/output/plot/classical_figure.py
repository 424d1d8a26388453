"""Figure ``classical``: velocity, force and impact ellipsoids in the same panels, with different units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from impact_posture.output.plot.ellipsoid_figure import draw_normals, normal_label, normals, square_panel
from impact_posture.output.plot.ellipsoid_shapes import COORDINATE_PLANES, Plane, longest, polar, shadow
from impact_posture.output.plot.result_view import ResultView, header_lines, jump_unit, number
from impact_posture.output.plot.style import BLUE, GREEN, INK, VERMILLION, framed, shared_legend
from impact_posture.system.arrays import Array

NOTES = (
    "Velocity, force and impact ellipsoids are divided by their own longest finite semi-axis in the initial posture "
    "(legend). Velocity J Jᵀ: contact velocities of joint velocities of norm 1. Force (J Jᵀ)⁻¹: contact forces of "
    "joint torques of norm 1 (unbounded where J is singular). Only impact, Λ$_c$ = J M⁻¹ W M⁻¹ Jᵀ, depends on "
    "inertia and supports. A direction with a large velocity has a small force, but an impact may follow neither.",
)
_LOOKS: dict[str, dict[str, Any]] = {
    "velocity": {"color": GREEN, "linestyle": (0, (5, 2)), "linewidth": 1.4, "zorder": 3.4},
    "force": {"color": VERMILLION, "linestyle": (0, (1, 1.2)), "linewidth": 1.6, "zorder": 3.6},
    "impact": {"color": BLUE, "linestyle": "-", "linewidth": 1.8, "zorder": 3.0},
}
# Unbounded ellipsoids are drawn with this half-length, in units of the panel.
_ENDLESS = 1e3


@dataclass(frozen=True, eq=False)
class Kind:
    """Velocity, force or impact ellipsoid in the initial and the optimal posture.

    Attributes:
        name: ``velocity``, ``force`` or ``impact``.
        formula: Formula of the matrix, for the legend.
        unit: Unit of the semi-axes.
        scale: Longest finite semi-axis in the initial posture.
        matrices: Matrices at the start and at the optimum, divided by ``scale²``.  Unbounded directions end far
            outside the panel.
        finite: Like ``matrices``, but with zero in the unbounded directions.
        endless: Unbounded directions at the start and at the optimum, as columns of shape (3, k).
    """

    name: str
    formula: str
    unit: str
    scale: float
    matrices: Sequence[Array]
    finite: Sequence[Array]
    endless: Sequence[Array]

    @property
    def label(self) -> str:
        """Legend entry: name, formula and scale."""
        return f"{self.name}  {self.formula}:  1 = {number(self.scale)} {self.unit}"


def kinds_of(view: ResultView) -> list[Kind]:
    """Return velocity, force and impact ellipsoids, scaled for comparison."""
    products = [J @ J.T for J in (view.jacobian(view.q_initial), view.jacobian(view.q_optimal))]
    impact = [view.before.ellipsoid, view.after.ellipsoid]
    bounded = np.zeros((3, 0))
    kinds = []
    for name, formula, unit, matrices, dual in (
        ("velocity", "J Jᵀ", "m/s", products, False),
        ("force", "(J Jᵀ)⁻¹", "N", products, True),
        ("impact", "Λ$_c$", f"{jump_unit(view)}/(N·s)", impact, False),
    ):
        finite = [polar(matrix, 0.0)[0] if dual else matrix for matrix in matrices]
        scale = longest(finite[0]) or longest(finite[1]) or 1.0
        cut = [polar(matrix, _ENDLESS * scale) if dual else (matrix, bounded) for matrix in matrices]
        drawn = [matrix / scale**2 for matrix, _ in cut]
        shown = [matrix / scale**2 for matrix in finite]
        kinds.append(Kind(name, formula, unit, scale, drawn, shown, [endless for _, endless in cut]))
    return kinds


def classical_figure(view: ResultView) -> Figure:
    """Draw the ellipsoids of ``JJᵀ``, ``(JJᵀ)⁻¹`` and ``Λ_c`` at the start and at the optimum.

    The panels show projections onto the coordinate planes.  All panels share a scale, but the three ellipsoids have
    different units.  If ``JJᵀ`` is singular, the force ellipsoid is unbounded, and its panel states this.
    """
    kinds = kinds_of(view)
    limit = 1.18 * max(1.0, *(longest(matrix) for kind in kinds for matrix in kind.finite))
    named = normals(view.before, view.after)
    with framed(*header_lines(view), 5.2, NOTES) as (figure, body):
        panels = body.subplots(2, 3)
        for row, word, which in ((panels[0], "before", 0), (panels[1], "after", 1)):
            normal = named[min(which, len(named) - 1)]
            for axes, plane in zip(row, COORDINATE_PLANES, strict=True):
                square_panel(axes, plane, limit, "1")
                axes.set_title(f"{word},  shadow on {plane.name}")
                for kind in kinds:
                    points = 721 if kind.endless[which].size else 181
                    axes.plot(*shadow(kind.matrices[which], plane.axes, points), **_LOOKS[kind.name])
                draw_normals(axes, plane, [normal], limit)
                axes.set_xlabel(axes.get_xlabel() + "".join(_unbounded(plane, kind, which) for kind in kinds))
        handles = [Line2D([], [], label=kind.label, **_LOOKS[kind.name]) for kind in kinds]
        handles.append(Line2D([], [], label=normal_label(named).split(", out")[0], color=INK, linewidth=1.1))
        shared_legend(body, handles, "upper")
    return figure


def _unbounded(plane: Plane, kind: Kind, which: int) -> str:
    """Return a note for the panel if the projection of an ellipsoid onto the plane is unbounded, else ``""``."""
    directions = kind.endless[which]
    seen = np.linalg.svd(plane.axes @ directions, compute_uv=False) if directions.shape[1] else np.zeros(0)
    rank = int((seen > 1e-6).sum())
    return f"\n{kind.name} unbounded: " + ("fills the plane" if rank == 2 else "a strip") if rank else ""
