"""Figures ``nullspace`` (over path length), ``path`` (over time) and ``tradeoff`` (over distance or peak force)."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from impact_posture.errors import InputError
from impact_posture.output.plot.result_view import (
    ResultView,
    TradeOffData,
    contact_speeds,
    header_lines,
    number,
    objective_unit,
    required,
)
from impact_posture.output.plot.style import BLUE, GRAY, GREEN, INK, LEGEND, PURPLE, VERMILLION, framed
from impact_posture.system.arrays import Array
from impact_posture.system.escape import plot_label

if TYPE_CHECKING:
    from impact_posture.posture.manifold.null_space_path import NullSpacePath

NOTES = {
    "distance": "Each point is the best posture found within this distance from the initial posture (joint angles, "
    "sliding joints and base in one norm)",
    "force": "Each point is the best posture of the search whose impact has at most this peak force",
}
_LINES = "; lines between points only join them. Hollow: not certified as an optimum."
_KNEE = (
    "At the knee, the share of the gain exceeds the share of the {} most. The knee is marked if the excess is 1/3 or "
    "more (a parabola reaches 1/4)."
)
# An axis is logarithmic if the ratio of the largest to the smallest value exceeds this number.
_SPREAD = 30.0
# Style of the vertical line at a posture.
_MARK: dict[str, Any] = {"color": INK, "linewidth": 0.8, "linestyle": ":", "zorder": 1}
QUANTITIES: dict[str, dict[str, Any]] = {
    "H": {"color": BLUE, "linestyle": "-", "linewidth": 1.9, "marker": "o"},
    "G": {"color": GREEN, "linestyle": (0, (1, 1)), "linewidth": 1.5, "marker": "^"},
    "V": {"color": VERMILLION, "linestyle": (0, (5, 2)), "linewidth": 1.5, "marker": "s"},
    "S": {"color": PURPLE, "linestyle": (0, (5, 1.5, 1, 1.5)), "linewidth": 1.5, "marker": "D"},
}


def path_figure(view: ResultView) -> Figure:
    """Draw H, G, V and S along ``view.path``, each quantity divided by its value at the start.

    Raises:
        InputError: The view has no path, or the arrays of the path have different lengths.
    """
    path = required(view.path, "path", "nullspace", "give ResultView.path")
    sizes = {name: np.shape(getattr(path, name)) for name in ("s", *QUANTITIES)}
    if len(path.s) < 2 or set(sizes.values()) != {(len(path.s),)}:
        fault = f"the path's arrays have shapes {', '.join(f'{k} {v}' for k, v in sizes.items())}"
        hint = "give at least two postures and one number of each quantity for each"
        raise InputError(fault, where="figure nullspace", hint=hint)
    with framed(*header_lines(view), 3.1, [share_notes("along the path", path)]) as (figure, body):
        axes = body.subplots()
        drawn = draw_shares(axes, path.s, path)
        end = "optimum" if view.motion is None or view.motion.found else "end of the path"
        for word, s, align in (("start", path.s[0], "left"), (end, path.s[-1], "right")):
            axes.axvline(s, **_MARK)
            look = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "ha": align, "size": LEGEND}
            axes.annotate(word, (s, 1.0), (0, 3), **look)
        axes.set_xlabel("path length in the null space, ∫‖dq‖  [rad, mixed with m]")
        if drawn:
            body.legend(loc="outside right center", title="value / start", title_fontsize=LEGEND, handlelength=3.2)
    return figure


def draw_shares(axes: Any, x: Array, data: NullSpacePath | TradeOffData) -> bool:
    """Draw H, G, V and S over ``x``, each divided by its value at the start; return whether a curve was drawn."""
    drawn = {name: share for name in QUANTITIES if (share := normalized(data, name)) is not None}
    values = np.concatenate([curve[np.isfinite(curve)] for curve, _ in drawn.values()]) if drawn else np.ones(1)
    log = spreads(values)
    every = max(len(x) // 10, 1)
    for name, (curve, at_start) in drawn.items():
        shown = np.where(curve > 0, curve, np.nan) if log else curve
        label = f"{name} / {number(at_start)}"
        axes.plot(x, shown, label=label, markevery=every, markersize=3.5, **QUANTITIES[name])
    axes.axhline(1.0, color=GRAY, linewidth=0.6, zorder=0)
    if log:
        log_axis(axes)
    else:
        axes.set_ylim(0.0, 1.12 * max(float(values.max()), 1.0))
    axes.grid(True)
    axes.set_ylabel("value / value at start  [1]" + (", log" if log else ""))
    return bool(drawn)


def spreads(values: Array, ratio: float = _SPREAD) -> bool:
    """Return whether the largest positive value exceeds ``ratio`` times the smallest, so a log axis is useful."""
    positive = values[values > 0]
    return bool(positive.size) and float(positive.max() / positive.min()) > ratio


def log_axis(axes: Any) -> None:
    """Make the vertical axis logarithmic, with numbers at major ticks only."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())


def normalized(data: NullSpacePath | TradeOffData, name: str) -> tuple[Array, float] | None:
    """Return a quantity divided by its first finite value, and this value; ``None`` if this value is not positive."""
    values = np.asarray(getattr(data, name), dtype=float)
    first = next(iter(values[np.isfinite(values)]), 0.0)
    return (values / first, float(first)) if first > 0 else None


def share_notes(where: str, data: NullSpacePath | TradeOffData) -> str:
    """Return the note that explains the curves of :func:`draw_shares`."""
    notes = "Each curve is divided by its value at the start; for H, V and S less is better. G is 1/effective mass."
    missing = [name for name in QUANTITIES if normalized(data, name) is None]
    if "S" in missing:
        notes += f" S is undefined {where}."
        missing.remove("S")
    return notes + (f" {', '.join(missing)} start at zero, which cannot be the divisor." if missing else "")


_BOUNDS = {
    "distance": "distance moved from the initial posture, at most  [rad, mixed with m]",
    "force": "peak force of the impact, at most  [N]",
}
_EXTRA = {"distance": "distance", "force": "extra force"}


def tradeoff_figure(view: ResultView) -> Figure:
    """Draw the objective over the bound on distance or force, and H, G, V and S in a second panel."""
    data = required(view.tradeoff, "trade-off", "tradeoff", "run optimize again with `tradeoff`")
    knee = [_KNEE.format(_EXTRA[data.against])] if data.knee is not None else []
    notes = [NOTES[data.against] + _LINES, *knee, share_notes("at these postures", data)]
    with framed(*header_lines(view), 5.6, notes) as (figure, body):
        upper, lower = body.subplots(2, 1, sharex=True, height_ratios=[1.25, 1])
        _objective(upper, data, view)
        drawn = draw_shares(lower, data.within, data)
        lower.set_xlabel(_BOUNDS[data.against])
        if data.knee is not None:
            lower.axvline(data.within[data.knee], **_MARK)
        handles = upper.get_legend_handles_labels()[0]
        if drawn:
            # A heading separates the entries of the two panels.
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
        # A margin above and below keeps the noise of an almost constant curve small.
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
    axes.axvline(x[data.knee], **_MARK)


def _title(data: TradeOffData) -> str:
    """Return the title: the gain at the knee or, without a knee, at half of the distance or extra force."""
    y, x = data.objective, data.within - data.within[0]
    gain = float(y[0] - y[-1])
    if not gain > 0:
        return "nothing is gained"
    if data.knee is not None:
        share, price = (y[0] - y[data.knee]) / gain, x[data.knee] / x[-1]
        return f"knee: {100 * share:.0f} % of the gain for {100 * price:.0f} % of the {_EXTRA[data.against]}"
    half = float(np.interp(x[-1] / 2, x, y))
    return f"half of the {_EXTRA[data.against]} yields {100 * (y[0] - half) / gain:.0f} % of the gain; no knee"


# Number of joints with a color and a name: the joints that move most.  Other joints are gray.
_NAMED = 8
# Joints that move less than this value, rad or m, are not drawn.
_MOVES = 1e-4
_SHARES: dict[str, dict[str, Any]] = {
    "velocity": {"color": BLUE, "linestyle": "-"},
    "torque": {"color": VERMILLION, "linestyle": (0, (5, 2))},
    "thrust": {"color": GREEN, "linestyle": (0, (1, 1))},
}
# Names of the base motions, by the first letter of the velocity.
_MOVED = {"v": "base along ", "w": "base about "}
_LEAST = "If torques, thrusts and foot forces are not unique, their largest share of a limit is minimized."
_NOTES = {
    "scaled": f"The whole motion has one time scale, so it meets a limit only at its fastest instant. {_LEAST}",
    "slowed": f"The speed at each place is as high as the limits allow, and low at corners. {_LEAST}",
    "time-optimal": "Time-optimal: a limit is met all the time, up to 1 %; the curves join the points of the motion.",
}


def motion_figure(view: ResultView) -> Figure:
    """Draw joint motion, objective, and velocities, torques and thrusts divided by their limits, over time."""
    motion = required(view.motion, "motion", "path", "run optimize again with `path`")
    use = required(motion.use, "motion", "path", "run optimize again with `path`")
    notes = [_NOTES.get(motion.timing, "")]
    notes += [f"Note: {motion.reason}."] if motion.reason else []
    if motion.strike is not None and motion.strike.rest_s < motion.strike.run_up_s:
        notes += ["Not shown: the limits of the controller on accelerations, which this motion also keeps."]
    notes += ["Dotted lines: start of the run-up or of the fall, and contact."] if motion.strike else []
    with framed(*header_lines(view), 6.2, notes) as (figure, body):
        joints, objective, shares = body.subplots(3, 1, sharex=True, height_ratios=[1.4, 1, 1])
        # The curves show the integral of the velocity, because an angle would jump after a full turn.
        played = motion.played
        t, q, v = played.t, played.q, played.v
        steps = np.diff(t)[:, None] * (v[1:] + v[:-1]) / 2
        moved = np.vstack([np.zeros_like(v[:1]), np.cumsum(steps, axis=0)])
        span = np.ptp(moved, axis=0)
        most = [k for k in np.argsort(-span, kind="stable") if span[k] > _MOVES]
        for rank, k in enumerate(most):
            look: dict[str, Any] = {"color": GRAY, "linewidth": 0.6}
            if rank < _NAMED:
                name = re.sub(r"^base ([vw])", lambda match: _MOVED[match[1]], view.robot.tangent_names[k])
                look = {"color": f"C{rank}", "linewidth": 1.3, "label": plot_label(name)}
            joints.plot(t, moved[:, k], **look)
        joints.set_ylabel("moved by  [rad or m]")
        joints.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), handlelength=2.4)
        objective.plot(use.at, motion.objectives, color=BLUE, linewidth=1.6)
        objective.set_ylabel(f"objective  [{objective_unit(view)}]")
        for name, style in _SHARES.items():
            values = getattr(use, name)
            if np.isfinite(values).any():
                shares.plot(use.at, values, label=name, linewidth=1.5, **style)
        shares.axhline(1.0, color=GRAY, linewidth=0.8, zorder=0)
        shares.set_ylim(0.0, None)
        shares.set_ylabel("share of the limit  [1]")
        shares.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), handlelength=3.2)
        shares.set_xlabel(f"time  [s]; path of {motion.length:.3g} rad (m), by {motion.method}")
        for axes in (joints, objective, shares):
            axes.grid(True)
            for time in () if motion.strike is None else (motion.strike.run_up_s, motion.strike.contact_s):
                axes.axvline(time, **_MARK)
        if motion.strike is not None:
            speed = objective.twinx()
            speed.plot(t, contact_speeds(view, q, v), color=PURPLE, linewidth=1.3, linestyle=(0, (3, 2)))
            speed.set_ylabel("contact speed  [m/s]", color=PURPLE)
        body.align_ylabels([joints, objective, shares])
    return figure
