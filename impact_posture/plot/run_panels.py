"""What the panels over time of the pictures of runs show: which stretch of time, which curves, which limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impact_posture.plot.run_view import Flags, RunView
from impact_posture.plot.shapes import Vector
from impact_posture.plot.style import BLUE, GRAY, GREEN, INK, ORANGE, PURPLE, SKY, VERMILLION
from impact_posture.plot.view import number

# Of that many joints a panel shows the curves.
SHOWN = 8
# Curves of one panel: they differ by color and dashes.
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
# Runs beside each other: the first is what the others are compared with, as before and after elsewhere.
RUNS: tuple[dict[str, Any], ...] = (LINES[1] | {"zorder": 3.5}, LINES[0] | {"linewidth": 1.6}, *LINES[2:])
# A limit farther away than this many times the largest value is named, not drawn.
_FAR = 4.0
# A command counts as at its limit within this share of the range.
_NEAR = 1e-3


@dataclass(frozen=True)
class Clip:
    """A stretch of a run's time as an axis shows it: ``scale (t − origin)`` from ``begin`` to ``end``.

    Attributes:
        begin: s.
        end: s.
        origin: What is zero on the axis, s.
        scale: Of the axis' unit in seconds: 1, or 1000 for milliseconds.
        label: Of the axis.
    """

    begin: float
    end: float
    origin: float = 0.0
    scale: float = 1.0
    label: str = "time  [s]"

    def x(self, t: Any) -> Any:
        """Times on the axis."""
        return self.scale * (t - self.origin)


def whole(view: RunView) -> Clip:
    """All of a run."""
    return Clip(float(view.t[0]), float(view.t[-1]))


def first_impact(view: RunView) -> Clip | None:
    """The first impact window with some air, in ms from its begin; ``None`` without one."""
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
    """From a second before the first impact window to a second after the last; all of a run without any."""
    if not view.impacts:
        return whole(view)
    air = 0.2 if view.pushed else 0.5
    begin, end = view.impacts[0].begin - air, view.impacts[-1].end + 2 * air
    return Clip(max(begin, float(view.t[0])), min(end, float(view.t[-1])))


@dataclass(frozen=True, eq=False)
class Panel:
    """What a row of panels shows, of several runs.

    Attributes:
        label: Of the upright axis.
        names: Of the curves.
        values: Curves of each run, shape (n, curves).
        limits: Lower and upper limit of the commands: dashed lines; empty for none.
        ranges: Of each run, a lower and an upper bound to shade between, shape (n, 2).
        stopped: When a curve's joint was at its stop, of each run, shape (n, curves).
        note: To be said below the picture.
        noisy: Whether the curves carry noise, as those of robots that fly.
    """

    label: str
    names: Sequence[str]
    values: Sequence[Vector]
    limits: tuple[float, float] | tuple[()] = ()
    ranges: Sequence[Vector] | None = None
    stopped: Sequence[Flags] | None = None
    note: str = ""
    noisy: bool = False

    def saturated(self, which: int) -> list[Flags]:
        """For each limit when a command of run ``which`` was at it, up to a thousandth of the range, shape (n,)."""
        if not self.limits:
            return []
        commands = self.values[which] if self.ranges is None else self.ranges[which]
        low, high = self.limits
        near = _NEAR * (high - low)
        return [np.any(commands <= low + near, axis=1), np.any(commands >= high - near, axis=1)]


def rotor_panel(views: Sequence[RunView]) -> Panel | None:
    """Rotor speeds, the range of their commands, and the limits, as shares of the highest speed.

    ``None`` of a robot without rotors.
    Commands carry the sensors' noise: six of them over each other cannot be told apart.
    """
    one = views[0]
    count = one.rotor_command.shape[1]
    if not count:
        return None
    # A robot.toml does not name the unit of its rotors' speeds.
    low, high = one.rotor_limits or (0.0, 1.0)
    names = [f"rotor {k + 1}" for k in range(count)]
    commands = [view.rotor_command / high for view in views]
    ranges = [np.stack([command.min(axis=1), command.max(axis=1)], axis=1) for command in commands]
    note = "Rotors: lines as they turn; the band holds all commands."
    speeds, limits = [view.rotor_speed / high for view in views], (low / high, 1.0) if one.rotor_limits else ()
    return Panel("rotor speed / highest  [1]", names, speeds, limits, ranges, note=note, noisy=True)


def control_panels(views: Sequence[RunView]) -> list[Panel]:
    """Commands, with their limits: of the rotors, of the joints."""
    return [panel for panel in (rotor_panel(views), torque_panel(views)) if panel is not None]


def torque_panel(views: Sequence[RunView]) -> Panel | None:
    """Commanded joint torques: of the joints that come closest to their limits, where there are many.

    In N·m where all that are shown have the same limit or none, else as shares of each joint's own.
    ``None`` of a robot without joints.
    """
    one, limits = views[0], views[0].torque_limits
    if not limits.size:
        return None
    largest = np.max([np.abs(view.torque).max(axis=0) for view in views], axis=0)
    bounded = np.flatnonzero(np.isfinite(limits))
    # Joints without a limit cannot come close to it: they are shown only where no joint has one.
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
    """Positions of the joints that move most, those in rad and those in m apart."""
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


def _largest(size: Vector) -> Any:
    """Indices of the largest, as many as are shown, in the order of the robot."""
    return np.sort(np.argsort(-size, kind="stable")[:SHOWN])
