"""Figure ``tradeoff``: the best objective within each distance from the initial posture, and H, G, V, S with it.

How the curve is found: :mod:`impact_posture.posture.pareto`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from impact_posture.errors import InputError
from impact_posture.plot.path_figure import draw_shares, log_axis, share_notes, spreads, undrawn
from impact_posture.plot.style import BLUE, GRAY, INK, VERMILLION, framed, style
from impact_posture.plot.view import ResultView, TradeOffData, header_lines, objective_unit

NOTES = (
    "Each point is the best posture found that moves at most so far from the initial one (joint angles, sliding "
    "joints and base taken together); lines between points only join them. Hollow: not certified as an optimum.",
)
_KNEE = (
    "The knee is the point whose share of the gain exceeds its share of the distance most, marked only if that is by "
    "1/3 or more (a parabola reaches 1/4)."
)


def tradeoff_figure(view: ResultView) -> Figure:
    """Draw the objective over the distance (log axis if it spreads widely), and below it H, G, V and S.

    Raises:
        InputError: The view has no trade-off.
    """
    data = view.tradeoff
    if data is None:
        raise InputError(
            "there is no trade-off to draw", where="figure tradeoff", hint="run optimize again with `tradeoff`"
        )
    knee = [_KNEE] if data.knee is not None else []
    with style():
        notes = [*NOTES, *knee, share_notes("at these postures", undrawn(data))]
        figure, body = framed(*header_lines(view), 5.6, [" ".join(notes)])
        upper, lower = body.subplots(2, 1, sharex=True, height_ratios=[1.25, 1])
        _objective(upper, data, view)
        drawn = draw_shares(lower, data.within, data)
        lower.set_xlabel("distance moved from the initial posture, at most  [rad, mixed with m]")
        if data.knee is not None:
            _upright(lower, data)
        handles = upper.get_legend_handles_labels()[0]
        if drawn:
            # A line without anything parts them from those of the panel below.
            handles += [Line2D([], [], linestyle="", label="value / start:"), *lower.get_legend_handles_labels()[0]]
        body.legend(handles=handles, loc="outside right center", handlelength=3.2)
        body.align_ylabels([upper, lower])
    return figure


def _objective(axes: Any, data: TradeOffData, view: ResultView) -> None:
    x, y = data.within, data.objective
    log = bool((y > 0).all()) and spreads(y)
    axes.plot(x, y, color=BLUE, linewidth=1.6, zorder=3)
    for mask, face, label in ((data.certified, BLUE, "certified"), (~data.certified, "white", "not certified")):
        if mask.any():
            look = {"linestyle": "", "marker": "o", "markersize": 5, "markeredgecolor": BLUE, "zorder": 4}
            axes.plot(x[mask], y[mask], markerfacecolor=face, label=label, **look)
    if log:
        log_axis(axes)
    else:
        # Air above and below, so that a curve that hardly falls does not fill the panel with noise.
        room = 0.08 * max(float(np.ptp(y)), 1e-3 * float(np.abs(y).max()))
        axes.set_ylim(float(y.min()) - room, float(y.max()) + 1.5 * room)
    axes.grid(True)
    kind = "objective" if not view.objective.normal_cone_deg else "worst objective of the cone"
    axes.set_ylabel(f"{kind} ({view.objective.kind})  [{objective_unit(view)}]" + (", log" if log else ""))
    axes.set_title(_title(data), parse_math=False)
    share = axes.secondary_yaxis("right", functions=(lambda v: 1 - v / y[0], lambda r: (1 - r) * y[0]))
    if not log:
        share.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:.3g}".replace("-", "−")))
        share.set_ylabel("reduction  [%]")
    else:
        share.set_visible(False)
    if data.knee is None:
        return
    if not log:
        ends = [0, -1]
        axes.plot(x[ends], y[ends], color=GRAY, linewidth=0.8, linestyle=(0, (1, 2)), label="in proportion", zorder=2)
    look = {"linestyle": "", "marker": "o", "markersize": 11, "markerfacecolor": "none", "markeredgewidth": 1.4}
    axes.plot(x[data.knee], y[data.knee], markeredgecolor=VERMILLION, label="knee", zorder=5, **look)
    _upright(axes, data)


def _upright(axes: Any, data: TradeOffData) -> None:
    axes.axvline(data.within[data.knee], color=INK, linewidth=0.8, linestyle=":", zorder=1)


def _title(data: TradeOffData) -> str:
    """What half of the way buys, or what the knee does."""
    y, x = data.objective, data.within
    gain = float(y[0] - y[-1])
    if not gain > 0:
        return "nothing is gained"
    if data.knee is not None:
        share, way = (y[0] - y[data.knee]) / gain, x[data.knee] / x[-1]
        return f"knee: {100 * share:.0f} % of the gain for {100 * way:.0f} % of the distance"
    half = float(np.interp(x[-1] / 2, x, y))
    return f"half of the distance buys {100 * (y[0] - half) / gain:.0f} % of the gain; no knee"
