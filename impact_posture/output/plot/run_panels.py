"""Select what a panel over time shows: time interval, curves, limits and notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from impact_posture.output.plot.result_view import mixed_unit, number
from impact_posture.output.plot.run_view import Flags, RunView
from impact_posture.output.plot.style import BLUE, GRAY, GREEN, INK, ORANGE, PURPLE, SKY, VERMILLION
from impact_posture.system.arrays import Array

# Largest number of joints in a panel.
SHOWN = 8
# Line styles for the curves of a panel.
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
# Line styles for the runs in a panel.  The first run has the style of "before" in other figures, the second run has
# the style of "after".
RUNS: tuple[dict[str, Any], ...] = (LINES[1] | {"zorder": 3.5}, LINES[0] | {"linewidth": 1.6}, *LINES[2:])
# A limit above this multiple of the largest value is not drawn, but a note below the figure states this limit.
_FAR = 4.0
# A command is at a limit if its distance from the limit is at most this share of the range.
_NEAR = 1e-3


@dataclass(frozen=True)
class Clip:
    """Time interval of a run, s.  The time axis shows ``scale (t − origin)``.

    ``scale`` is 1 for an axis in seconds, or 1000 for milliseconds.
    """

    begin: float
    end: float
    origin: float = 0.0
    scale: float = 1.0
    label: str = "time  [s]"

    def x(self, t: Any) -> Any:
        """Return ``scale (t − origin)``."""
        return self.scale * (t - self.origin)


def whole(view: RunView) -> Clip:
    """Return the clip of a whole run."""
    return Clip(float(view.t[0]), float(view.t[-1]))


def first_impact(view: RunView) -> Clip | None:
    """Return the clip of the first impact window with a margin, in ms; ``None`` if there was no impact."""
    if not view.impacts:
        return None
    window = view.impacts[0]
    length = window.end - window.begin
    what = "push" if view.pushed else ("first touch" if window.touched else "expected touch")
    begin, end = max(window.begin - 0.2 * length, view.t[0]), min(window.end + 0.35 * length, view.t[-1])
    return Clip(float(begin), float(end), window.begin, 1000.0, f"time since {what}  [ms]")


def impacts(view: RunView) -> Clip:
    """Return the clip of all impact windows with a margin; without an impact, the clip of the whole run."""
    if not view.impacts:
        return whole(view)
    air = 0.2 if view.pushed else 0.5
    begin, end = view.impacts[0].begin - air, view.impacts[-1].end + 2 * air
    return Clip(max(begin, float(view.t[0])), min(end, float(view.t[-1])))


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves over time of several runs.

    Attributes:
        label: Label of the vertical axis.
        names: Names of the curves, or names of the runs with ``overlay``; may be empty.
        values: For each run, the samples of the curves, shape (n, curves).
        limits: Lower and upper limit of the commands, drawn as dashed lines; empty for none.
        ranges: For each run, lower and upper bound of a shaded band, shape (n, 2).
        stopped: For each run, whether the joint of a curve was at its stop, shape (n, curves).
        note: Sentence below the figure.
        noisy: Whether the curves contain noise, as the commands of flying robots do.
        scale: Scale of the vertical axis: ``auto``, ``from zero``, or ``metric`` (logarithmic if H varies strongly).
        overlay: Whether all runs are drawn in the same panel, with different line styles.
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
        """Return for each limit whether any command of run ``which`` is at the limit, shape (n,)."""
        if not self.limits:
            return []
        commands = self.values[which] if self.ranges is None else self.ranges[which]
        low, high = self.limits
        near = _NEAR * (high - low)
        return [np.any(commands <= low + near, axis=1), np.any(commands >= high - near, axis=1)]


def metric_panels(view: RunView) -> list[Panel]:
    """Return panels for H, ``‖ν‖``, contact force, and the activation of the impact-robust term if it changes."""
    n = np.array(view.contact.normal)
    normal = view.force @ n
    if view.pushed:
        force = Panel("push  [N]", (), [normal[:, None]])
    else:
        friction = np.linalg.norm(view.force - normal[:, None] * n, axis=1)
        names = ("force: normal, peak", "force: friction")
        note = "The normal force is the largest value within each tick of the controller."
        force = Panel("force  [N]", names, [np.stack([view.peak, friction], axis=1)], note=note)
    panels = [metric_panel([view]), replace(speed_panel([view]), scale="auto", overlay=False), force]
    if np.ptp(view.level) > 1e-9:
        panels.append(Panel("activation of\nthe term  [1]", (), [view.level[:, None]]))
    return panels


def metric_panel(views: Sequence[RunView], names: Sequence[str] = ()) -> Panel:
    """Return a panel with H of all runs."""
    values = [view.objective[:, None] for view in views]
    return Panel("H  [‖Δν‖²/(N·s)²]", names, values, scale="metric", overlay=bool(names))


def speed_panel(views: Sequence[RunView]) -> Panel:
    """Return a panel with ``‖ν‖`` of all runs."""
    label = f"‖ν‖  [{mixed_unit(views[0].robot).strip('()')}]"
    return Panel(label, (), [view.speed[:, None] for view in views], scale="from zero", overlay=True)


def rotor_panel(views: Sequence[RunView]) -> Panel | None:
    """Return a panel with rotor speeds divided by the highest speed; ``None`` for a robot without rotors.

    Commands are a shaded band, because sensor noise makes their curves indistinguishable.
    """
    bounds, count = views[0].rotor_limits, views[0].rotor_command.shape[1]
    if not count:
        return None
    # The unit of rotor speeds is unknown, because robot.toml does not state it.  So draw ratios.
    low, high = bounds or (0.0, 1.0)
    names = [f"rotor {k + 1}" for k in range(count)]
    commands = [view.rotor_command / high for view in views]
    ranges = [np.stack([command.min(axis=1), command.max(axis=1)], axis=1) for command in commands]
    note = "Rotors: the lines are measured speeds, and the band contains all commands."
    speeds, limits = [view.rotor_speed / high for view in views], (low / high, 1.0) if bounds else ()
    return Panel("rotor speed / highest  [1]", names, speeds, limits, ranges, note=note, noisy=True)


def control_panels(views: Sequence[RunView]) -> list[Panel]:
    """Return panels for the commands of rotors and joints, with their limits."""
    return [panel for panel in (rotor_panel(views), torque_panel(views)) if panel is not None]


def torque_panel(views: Sequence[RunView]) -> Panel | None:
    """Return a panel with commanded joint torques; ``None`` for a robot without joints.

    If there are many joints, the panel shows the joints that come closest to their limits.  If the shown joints have
    different limits, each torque is divided by the limit of its joint.
    """
    first, limits = views[0], views[0].torque_limits
    if not limits.size:
        return None
    largest = np.max([np.abs(view.torque).max(axis=0) for view in views], axis=0)
    bounded = np.flatnonzero(np.isfinite(limits))
    # Joints without a limit are shown only if no joint has a limit.
    eligible = bounded if bounded.size else np.arange(limits.size)
    shown = eligible[_largest((largest / limits if bounded.size else largest)[eligible])]
    notes = []
    if len(shown) < len(eligible):
        which = "come closest to their limits" if bounded.size else "exert most"
        notes.append(f"Torques of the {SHOWN} of {len(eligible)} joints that {which}.")
    if 0 < bounded.size < limits.size:
        notes.append("Torques without a limit are left out.")
    units = sorted({"N·m" if first.joint_units[k] == "rad" else "N" for k in shown}, reverse=True)
    scale, unit = limits[shown], ", ".join(units)
    if bounded.size and (len(set(scale)) > 1 or len(units) > 1):
        notes.append("Each torque is divided by the joint's own limit.")
        label, unit, limit = "torque / limit  [1]", "", 1.0
    else:
        scale, label, limit = np.ones(len(shown)), f"joint torque  [{unit}]", float(scale[0])
    values = [view.torque[:, shown] / scale for view in views]
    lines: tuple[float, float] | tuple[()] = (-limit, limit) if bounded.size else ()
    peak = max(float(np.abs(value).max()) for value in values)
    if lines and limit > _FAR * peak:
        named = f"The torque limits (±{number(limit)} {unit}) lie outside of the panels."
        notes.append(named if unit else f"All torques stay within {number(100 * peak)} % of their limits.")
        lines = ()
    names = [first.joint_names[k] for k in shown]
    return Panel(label, names, values, lines, note=" ".join(notes), noisy=first.rotor_limits is not None)


def joint_panels(views: Sequence[RunView]) -> list[Panel]:
    """Return a panel with joint angles and a panel with positions of sliding joints.  Show joints that move most."""
    first = views[0]
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
        joints = [int(k) for k in shown if first.joint_units[k] == unit]
        if joints:
            stopped = [view.at_stop[:, view.robot.first_joint :][:, joints] for view in views]
            values = [view.positions[:, joints] for view in views]
            names = [first.joint_names[k] for k in joints]
            panels.append(Panel(label, names, values, stopped=stopped, note=" ".join(notes)))
    return panels


def _largest(size: Array) -> Any:
    """Return the indices of the :data:`SHOWN` largest entries, in the order of the robot."""
    return np.sort(np.argsort(-size, kind="stable")[:SHOWN])
