"""Content of the panels over time: stretches of time, curves and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from impact_posture.output.plot.result_view import mixed_unit, number
from impact_posture.output.plot.run_view import Flags, RunView
from impact_posture.output.plot.style import BLUE, GRAY, GREEN, INK, ORANGE, PURPLE, SKY, VERMILLION
from impact_posture.system.arrays import Array

# Most joints that a panel shows.
SHOWN = 8
# Looks of the curves of a panel, which differ by color and dashes.
LINES: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "linestyle": "-", "linewidth": 1.3},
    {"color": VERMILLION, "linestyle": (0, (4, 1.5)), "linewidth": 1.3},
    {"color": GREEN, "linestyle": (0, (1, 1)), "linewidth": 1.4},
    {"color": PURPLE, "linestyle": (0, (6, 1.5, 1, 1.5)), "linewidth": 1.3},
    {"color": INK, "linestyle": "-", "linewidth": 0.8},
    {"color": SKY, "linestyle": (0, (8, 2)), "linewidth": 1.3},
    {"color": ORANGE, "linestyle": (0, (3, 1, 1, 1, 1, 1)), "linewidth": 1.3},
    {"color": GRAY, "linestyle": (0, (2, 2)), "linewidth": 1.0},
)
# Looks of runs in a panel. The others are compared with the first, as after is with before elsewhere.
RUNS: tuple[dict[str, Any], ...] = (LINES[1] | {"zorder": 3.5}, LINES[0] | {"linewidth": 1.6}, *LINES[2:])
# A limit farther away than this many times the largest value is named, not drawn.
_FAR = 4.0
# A command counts as at its limit within this share of the range.
_NEAR = 1e-3


@dataclass(frozen=True)
class Clip:
    """Stretch of time of a run on an axis, which shows ``scale (t − origin)`` from ``begin`` to ``end``.

    Attributes:
        begin: First time, s.
        end: Last time, s.
        origin: Time at the zero of the axis, s.
        scale: Units of the axis per second: 1, or 1000 for milliseconds.
        label: Name of the axis.
    """

    begin: float
    end: float
    origin: float = 0.0
    scale: float = 1.0
    label: str = "time  [s]"

    def x(self, t: Any) -> Any:
        """Return times as the axis counts them."""
        return self.scale * (t - self.origin)


def whole(view: RunView) -> Clip:
    """Return the clip of a whole run."""
    return Clip(float(view.t[0]), float(view.t[-1]))


def first_impact(view: RunView) -> Clip | None:
    """Return the clip of the first impact window with a margin, in ms from its begin; ``None`` without impact."""
    if not view.impacts:
        return None
    span = view.impacts[0]
    length = span.end - span.begin
    what = "push" if view.pushed else ("first touch" if span.touched else "expected touch")
    begin = max(span.begin - 0.2 * length, float(view.t[0]))
    return Clip(
        begin, min(span.end + 0.35 * length, float(view.t[-1])), span.begin, 1000.0, f"time since {what}  [ms]"
    )


def impacts(view: RunView) -> Clip:
    """Return the clip of all impact windows with a margin; the whole run without impact."""
    if not view.impacts:
        return whole(view)
    air = 0.2 if view.pushed else 0.5
    begin, end = view.impacts[0].begin - air, view.impacts[-1].end + 2 * air
    return Clip(max(begin, float(view.t[0])), min(end, float(view.t[-1])))


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over time of several runs.

    Attributes:
        label: Name of the upright axis.
        names: Names of the curves, of the runs where they are overlaid, or none.
        values: Curves of each run, shape (n, curves).
        limits: Lower and upper limit of the commands, drawn as dashed lines; empty for none.
        ranges: Lower and upper bound to shade between, for each run, shape (n, 2).
        stopped: Whether the joint of a curve was at its stop, for each run, shape (n, curves).
        note: Sentence below the figure.
        noisy: Whether the curves carry noise, as those of flying robots do.
        scale: Scale of the upright axis: ``auto``, ``from zero``, or ``metric`` (logarithmic where it spreads).
        overlay: Whether all runs are drawn in the same panel, in looks of their own.
    """

    label: str
    names: Sequence[str]
    values: Sequence[Array]
    limits: tuple[float, float] | tuple[()] = ()
    ranges: Sequence[Array] | None = None
    stopped: Sequence[Flags] | None = None
    note: str = ""
    noisy: bool = False
    scale: str = "auto"
    overlay: bool = False

    def saturated(self, which: int) -> list[Flags]:
        """Return for each limit when a command of run ``which`` was at it, up to 1/1000 of the range, shape (n,)."""
        if not self.limits:
            return []
        commands = self.values[which] if self.ranges is None else self.ranges[which]
        low, high = self.limits
        near = _NEAR * (high - low)
        return [np.any(commands <= low + near, axis=1), np.any(commands >= high - near, axis=1)]


def metric_panels(view: RunView) -> list[Panel]:
    """H, ``‖ν‖``, the contact force, and the level of the impact-robust term where it changes."""
    n = np.array(view.contact.normal)
    normal = view.force @ n
    if view.pushed:
        force = Panel("push  [N]", (), [normal[:, None]])
    else:
        friction = np.linalg.norm(view.force - normal[:, None] * n, axis=1)
        names = ("force: normal, peak", "force: friction")
        note = "The normal force is the largest one within each tick of the controller."
        force = Panel("force  [N]", names, [np.stack([view.peak, friction], axis=1)], note=note)
    panels = [Panel("H  [‖Δν‖²/(N·s)²]", (), [view.objective[:, None]], scale="metric")]
    panels += [replace(speed_panel([view]), scale="auto", overlay=False), force]
    if np.ptp(view.level) > 1e-9:
        panels.append(Panel("activation of\nthe term  [1]", (), [view.level[:, None]]))
    return panels


def speed_panel(views: Sequence[RunView]) -> Panel:
    """``‖ν‖`` of all runs in the same panel."""
    label = f"‖ν‖  [{mixed_unit(views[0].robot).strip('()')}]"
    return Panel(label, (), [view.speed[:, None] for view in views], scale="from zero", overlay=True)


def rotor_panel(views: Sequence[RunView]) -> Panel | None:
    """Rotor speeds, the range of their commands, and the limits, as shares of the highest speed.

    ``None`` for a robot without rotors.  Commands carry the noise of the sensors. Six noisy curves could not
    be told apart.
    """
    one = views[0]
    count = one.rotor_command.shape[1]
    if not count:
        return None
    # A robot.toml does not name the unit of rotor speeds.
    low, high = one.rotor_limits or (0.0, 1.0)
    names = [f"rotor {k + 1}" for k in range(count)]
    commands = [view.rotor_command / high for view in views]
    ranges = [np.stack([command.min(axis=1), command.max(axis=1)], axis=1) for command in commands]
    note = "Rotors: the lines are measured speeds, and the band contains all commands."
    speeds, limits = [view.rotor_speed / high for view in views], (low / high, 1.0) if one.rotor_limits else ()
    return Panel("rotor speed / highest  [1]", names, speeds, limits, ranges, note=note, noisy=True)


def control_panels(views: Sequence[RunView]) -> list[Panel]:
    """Panels of the rotor and joint commands with their limits."""
    return [panel for panel in (rotor_panel(views), torque_panel(views)) if panel is not None]


def torque_panel(views: Sequence[RunView]) -> Panel | None:
    """Commanded joint torques; of many joints, those that come closest to their limits.

    They are in N·m where all shown joints have the same limit or none, else shares of the limit of each joint.
    ``None`` for a robot without joints.
    """
    one, limits = views[0], views[0].torque_limits
    if not limits.size:
        return None
    largest = np.max([np.abs(view.torque).max(axis=0) for view in views], axis=0)
    bounded = np.flatnonzero(np.isfinite(limits))
    # Joints without a limit cannot come close to it. They are shown only where no joint has a limit.
    eligible = bounded if bounded.size else np.arange(limits.size)
    shown = eligible[_largest((largest / limits if bounded.size else largest)[eligible])]
    notes = []
    if len(shown) < len(eligible):
        which = "come closest to their limits" if bounded.size else "exert most"
        notes.append(f"Torques of the {SHOWN} of {len(eligible)} joints that {which}.")
    if 0 < bounded.size < limits.size:
        notes.append("Torques without a limit are left out.")
    units = sorted({"N·m" if one.joint_units[k] == "rad" else "N" for k in shown}, reverse=True)
    own, unit = limits[shown], ", ".join(units)
    if bounded.size and (len(set(own)) > 1 or len(units) > 1):
        notes.append("Each torque is divided by the joint's own limit.")
        scale, label, unit, limit = own, "torque / limit  [1]", "", 1.0
    else:
        scale, label, limit = np.ones(len(shown)), f"joint torque  [{unit}]", float(own[0])
    values = [view.torque[:, shown] / scale for view in views]
    lines: tuple[float, float] | tuple[()] = (-limit, limit) if bounded.size else ()
    peak = max(float(np.abs(value).max()) for value in values)
    if lines and limit > _FAR * peak:
        named = f"The torque limits (±{number(limit)} {unit}) lie outside of the panels."
        notes.append(named if unit else f"All stay within {number(100 * peak)} % of it.")
        lines = ()
    return Panel(
        label,
        [one.joint_names[k] for k in shown],
        values,
        lines,
        note=" ".join(notes),
        noisy=one.rotor_limits is not None,
    )


def joint_panels(views: Sequence[RunView]) -> list[Panel]:
    """Panels of the positions of the joints that move most: those in rad, and those in m."""
    one = views[0]
    moved = np.max([np.ptp(view.positions, axis=0) for view in views], axis=0)
    single = np.flatnonzero(np.isfinite(moved))
    shown = single[_largest(moved[single])]
    notes = []
    if len(shown) < single.size:
        notes.append(f"Shown: the {SHOWN} of {single.size} joints that move most.")
    if single.size < moved.size:
        notes.append("Joints of several degrees of freedom have no curve.")
    panels = []
    for unit, label in (("rad", "joint angle  [rad]"), ("m", "sliding joint  [m]")):
        own = [int(k) for k in shown if one.joint_units[k] == unit]
        if own:
            stopped = [view.at_stop[:, view.first_joint :][:, own] for view in views]
            values = [view.positions[:, own] for view in views]
            names = [one.joint_names[k] for k in own]
            panels.append(Panel(label, names, values, stopped=stopped, note=" ".join(notes)))
    return panels


def _largest(size: Array) -> Any:
    """Return the indices of the :data:`SHOWN` largest entries, in the order of the robot."""
    return np.sort(np.argsort(-size, kind="stable")[:SHOWN])
