"""Figure ``path``: joints, objective and shares of the limits along the path to the optimum, over time."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from impact_posture.errors import InputError
from impact_posture.escape import plot_label
from impact_posture.plot.style import BLUE, GRAY, GREEN, VERMILLION, framed
from impact_posture.plot.view import ResultView, header_lines, objective_unit

# Joints that move most get a curve in color and a name; the others are gray.
_NAMED = 8
# A joint that moves less is not drawn, rad or m.
_MOVES = 1e-4
_SHARES: dict[str, dict[str, Any]] = {
    "velocity": {"color": BLUE, "linestyle": "-"},
    "torque": {"color": VERMILLION, "linestyle": (0, (5, 2))},
    "thrust": {"color": GREEN, "linestyle": (0, (1, 1))},
}
_SCALED = (
    "One time scale for the whole motion: its fastest instant just meets a limit. Torques, thrusts and forces "
    "on the feet that are not determined are those whose largest share is least."
)
_OPTIMAL = "Time-optimal: at each instant a limit is met, up to 1 % between grid points."


def motion_figure(view: ResultView) -> Figure:
    """Draw how far each joint has moved, the objective, and the shares of the limits over time.

    Raises:
        InputError: The view has no motion.
    """
    motion = view.motion
    if motion is None or motion.use is None:
        raise InputError("there is no motion to draw", where="figure path", hint="run optimize again with `path`")
    notes = [_SCALED if motion.timing == "scaled" else _OPTIMAL]
    notes += [f"Note: {motion.reason}."] if motion.reason else []
    with framed(*header_lines(view), 6.2, notes) as (figure, body):
        joints, objective, shares = body.subplots(3, 1, sharex=True, height_ratios=[1.4, 1, 1])
        # The integral of the velocities, which has no jump where an angle wraps.
        steps = np.diff(motion.t)[:, None] * (motion.v[1:] + motion.v[:-1]) / 2
        moved = np.vstack([np.zeros_like(motion.v[:1]), np.cumsum(steps, axis=0)])
        span = np.ptp(moved, axis=0)
        most = [k for k in np.argsort(-span, kind="stable") if span[k] > _MOVES]
        for rank, k in enumerate(most):
            look: dict[str, Any] = {"color": GRAY, "linewidth": 0.6}
            if rank < _NAMED:
                look = {"color": f"C{rank}", "linewidth": 1.3, "label": plot_label(view.robot.tangent_names[k])}
            joints.plot(motion.t, moved[:, k], **look)
        joints.set_ylabel("moved by  [rad or m]")
        joints.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), handlelength=2.4)
        objective.plot(motion.use.at, motion.objectives, color=BLUE, linewidth=1.6)
        objective.set_ylabel(f"objective  [{objective_unit(view)}]")
        for name, style in _SHARES.items():
            values = getattr(motion.use, name)
            if np.isfinite(values).any():
                shares.plot(motion.use.at, values, label=name, linewidth=1.5, **style)
        shares.axhline(1.0, color=GRAY, linewidth=0.8, zorder=0)
        shares.set_ylim(0.0, None)
        shares.set_ylabel("share of the limit  [1]")
        shares.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), handlelength=3.2)
        shares.set_xlabel(f"time  [s]; path of {motion.length:.3g} rad (m), found by {motion.method}")
        for axes in (joints, objective, shares):
            axes.grid(True)
        body.align_ylabels([joints, objective, shares])
    return figure
