"""Figure ``jump``: the velocity jump Δν of each joint at the start and at the optimum.

One panel shows the jump per unit impulse, the other panel the jump at the approach speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from impact_posture.impact.evaluation.coulomb_jump import CoulombJump, coulomb_jump
from impact_posture.impact.evaluation.impact_effect import tangent_units
from impact_posture.impact.evaluation.velocity_jump import normal_jump
from impact_posture.output.plot.result_view import ResultView, header_lines, jump_unit, number
from impact_posture.output.plot.style import AFTER_BAR, BEFORE_BAR, INK, VERMILLION, framed, shared_legend
from impact_posture.system.arrays import Array
from impact_posture.system.escape import plot_label

_ROW = 0.17


def jump_figure(view: ResultView) -> Figure:
    """Draw Δν as horizontal bars, per impulse and for the approach speed v.

    The left column shows ``a = M⁻¹Jᵀn`` per N·s.  The right column shows ``a(1+e)v/G``.  Diamonds in this column show
    the jump with friction, if this jump is defined.  Linear and angular velocities of the base, turning joints and
    sliding joints have separate panels.
    """
    groups = groups_of(view)
    gain = normal_jump(view.speed, view.restitution)
    states = (view.before, view.after)
    rubbed = [coulomb_jump(view.objective, q, gain) for q in (view.q_initial, view.q_optimal)]
    before, after = rubbed
    with_friction = ""
    if before is not None and after is not None:
        with_friction = f"\nwith friction {before.friction:g}: ‖Δν‖ = {number(before.norm)} → {number(after.norm)}"
    columns: list[tuple[str, str, list[Array], list[Array | None], str]] = [
        ("per impulse of 1 N·s", "/(N·s)", [state.jump for state in states], [None, None], _norms(view, "H", 1.0)),
        (
            f"for an approach at {view.speed:g} m/s, e = {view.restitution:g}",
            "",
            [gain / state.G * state.jump if state.G > 0 else 0 * state.jump for state in states],
            [None if jump is None else jump.velocity for jump in rubbed],
            _norms(view, "V", gain) + with_friction,
        ),
    ]
    heights = [0.42 + _ROW * len(indices) for _, indices, _ in groups]
    with framed(*header_lines(view), sum(heights) + 0.75, _notes(view, rubbed)) as (figure, body):
        panels: Any = body.subplots(len(groups), 2, squeeze=False, sharey="row", height_ratios=heights)
        for row, (name, indices, unit) in zip(panels, groups, strict=True):
            names = [view.robot.tangent_names[k].removeprefix("base ") for k in indices]
            for axes, (_, per, jumps, points, _) in zip(row, columns, strict=True):
                _bars(axes, [jump[indices] for jump in jumps], [p if p is None else p[indices] for p in points])
                axes.set_xlabel(f"Δν  [{unit}{per}]", labelpad=1)
            row[0].set_yticks(range(len(names)), [plot_label(name) for name in names])
            row[0].set_ylim(len(names) - 0.4, -0.6)
            row[0].set_ylabel(name)
        for axes, (title, _, _, _, norm) in zip(panels[0], columns, strict=True):
            axes.set_title(f"{title}\n{norm}", parse_math=False)
        body.align_ylabels(list(panels[:, 0]))
        shared_legend(body, _handles(rubbed), "upper")
    return figure


def groups_of(view: ResultView) -> list[tuple[str, list[int], str]]:
    """Return the groups of entries of ν that share a panel: name, indices and unit."""
    units = tangent_units(view.robot)
    base = view.robot.first_joint
    groups = [("base,\nlinear", [0, 1, 2], "m/s"), ("base,\nangular", [3, 4, 5], "rad/s")] if base else []
    for name, unit in (("joints", "rad/s"), ("sliding\njoints", "m/s")):
        groups.append((name, [k for k in range(base, view.robot.nv) if units[k] == unit], unit))
    return [group for group in groups if group[1]]


def _bars(axes: Any, jumps: list[Array], points: list[Array | None]) -> None:
    rows = np.arange(len(jumps[0]))
    for shift, jump, point, bar in zip((-0.2, 0.2), jumps, points, (BEFORE_BAR, AFTER_BAR), strict=True):
        # A single patch with gaps draws much faster than a patch for each bar.
        edges = ((rows + shift)[:, None] + [-0.18, 0.18]).ravel()
        axes.stairs(np.insert(jump, rows[1:], np.nan), edges, orientation="horizontal", fill=True, **bar)
        if point is not None:
            edge = VERMILLION if shift < 0 else INK
            look = {"color": "white", "markeredgecolor": edge, "markeredgewidth": 0.8}
            axes.plot(point, rows + shift, "D", markersize=3.2, **look)
    axes.use_sticky_edges = False
    axes.axvline(0.0, color=INK, linewidth=0.6)
    axes.grid(True, axis="x")
    axes.locator_params(axis="x", nbins=6)
    axes.tick_params(axis="y", length=0)
    largest = max(float(np.abs(v).max()) for v in (*jumps, *(p for p in points if p is not None)))
    if largest < 1e-12:
        axes.set_xlim(-1, 1)


def _norms(view: ResultView, name: str, gain: float) -> str:
    first, last = (number(gain * float(np.sqrt(max(getattr(at, name), 0.0)))) for at in (view.before, view.after))
    # Only the shorter of the two titles has space for the unit.
    factor, unit = ("", f" {jump_unit(view)}") if gain == 1 else (f"{gain:g} m/s · ", "")
    return f"‖Δν‖ = {factor}√{name} = {first} → {last}{unit}"


def _notes(view: ResultView, rubbed: Sequence[CoulombJump | None]) -> list[str]:
    notes = "Bars: no friction. A posture can lower one column and raise the other: the impulse grows as G falls."
    still = [word for word, state in (("before", view.before), ("after", view.after)) if not state.G > 0]
    if still:
        notes += f" The contact cannot move along n {' and '.join(still)} (G = 0): no jump for an approach."
    named = [(word, jump) for word, jump in zip(("before", "after"), rubbed, strict=True) if jump is not None]
    if not named:
        return [notes + " With friction, the jump is undefined in both postures."]
    fates = " and ".join(f"{'sticks' if jump.sticks else 'slips'} {word}" for word, jump in named)
    return [notes + f" Diamonds: with friction {named[0][1].friction:g} the contact point {fates}."]


def _handles(rubbed: Sequence[CoulombJump | None]) -> list[Any]:
    handles: list[Any] = [Patch(label="before", **BEFORE_BAR), Patch(label="after", **AFTER_BAR)]
    for word, edge, jump in zip(("before", "after"), (VERMILLION, INK), rubbed, strict=True):
        if jump is not None:
            handles.append(
                Line2D([], [], linestyle="", marker="D", markersize=4, color="white", markeredgecolor=edge,
                       label=f"{word}, with friction")
            )  # fmt: skip
    return handles
