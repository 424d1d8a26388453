"""What a run is measured by: the paper's metrics and those without which they mislead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.simulation.recorder import STATUSES
from impact_posture.simulation.run import Run
from impact_posture.simulation.scenario import RepeatedContacts, Setup
from impact_posture.simulation.series import Series, Window
from impact_posture.tsid.controller import Status

Flags = NDArray[np.bool_]

# Within how long after the first touch the velocity's jump is looked for, s.
JUMP = 0.015
# A command counts as saturated within this share of the range of its limit.
_NEAR = 1e-3


@dataclass(frozen=True)
class Metrics:
    """Of one run; sums over its contacts.

    Attributes:
        q_total_impact: ``∫‖ν‖dt`` over the impact windows (m and rad mixed, as in the paper).
        q_total_impact_base: The same of the floating base's six entries.
        q_total_impact_joints: The same of the joints'.
        q_total_dwell: The same as the first over the dwell windows; 0 for pushes.
        q_total_recovery: The same over the recovery windows: a push that is stored and given back is in here.
        peak_jump: Largest ``‖ν(t) − ν⁻‖`` within 15 ms of the first touch, mean over the contacts that came about (0
            without any); for pushes the largest ``‖ν‖`` within the window.
        peak_jump_max: The largest of them.
        peak_recovery: As ``peak_jump``, but looked for over the whole recovery window.
        peak_force: Largest normal force within the impact windows, N; for pushes the push.
        saturation_inside: Seconds within the impact windows with a rotor or a joint at a control limit.
        saturation_outside: Seconds without.
        saturation_rotors: Seconds within the impact windows with a rotor at a limit.
        relaxed_ticks: Ticks in which a level gave way.
        failed_ticks: Ticks that held the command before.
        slip: Way that the shape that hits (the fastest foot, for pushes) slid within the impact windows, m.
        stops: Joints at a position limit within the impact windows that were not there at the start.
        contacts: How many contacts (or pushes) came about.
        contacts_asked: How many the scenario asks for.
        rested: Whether the robot was at rest before it was pushed; true for contacts.
    """

    q_total_impact: float
    q_total_impact_base: float
    q_total_impact_joints: float
    q_total_dwell: float
    q_total_recovery: float
    peak_jump: float
    peak_jump_max: float
    peak_recovery: float
    peak_force: float
    saturation_inside: float
    saturation_outside: float
    saturation_rotors: float
    relaxed_ticks: int
    failed_ticks: int
    slip: float
    stops: tuple[str, ...]
    contacts: int
    contacts_asked: int
    rested: bool = True

    def to_dict(self) -> dict[str, object]:
        """JSON content."""
        found = {name: getattr(self, name) for name in self.__dataclass_fields__}
        saturation = {key: found.pop(f"saturation_{key}") for key in ("inside", "outside", "rotors")}
        found["stops"] = list(self.stops)
        return {**found, "saturation_s": saturation}


def measure(setup: Setup, run: Run) -> Metrics:
    """Measure a run."""
    series, impacts, task = run.series, run.impacts, setup.scenario.task
    inside: Flags = np.zeros(series.t.size, dtype=bool)
    for window in impacts:
        inside[series.slice(window.begin, window.end)] = True
    period = setup.scenario.control.period
    base = 6 if setup.robot.floating else 0
    speed = np.linalg.norm(series.v, axis=1)
    rotors, joints = saturated(setup, series)
    relaxed = series.status == STATUSES.index(Status.RELAXED)
    failed = ~relaxed & (series.status != STATUSES.index(Status.SOLVED))
    dwell, recovery = (
        sum(float(speed[series.slice(w.begin, w.end)].sum()) * period for w in run.windows if w.kind == kind)
        for kind in ("dwell", "recovery")
    )
    # An impact that never came is no small one.
    jumps = [jump(setup, series, w) for w in impacts if w.touched] or [0.0]
    later = [_peak(setup, series, w, w.end) for w in run.windows if w.kind == "recovery" and w.touched] or [0.0]
    stopped = (series.at_stop[inside] & ~series.at_stop[0]).any(axis=0) if inside.any() else np.zeros(0, bool)
    return Metrics(
        q_total_impact=float(speed[inside].sum() * period),
        q_total_impact_base=float(np.linalg.norm(series.v[inside, :base], axis=1).sum() * period),
        q_total_impact_joints=float(np.linalg.norm(series.v[inside, base:], axis=1).sum() * period),
        q_total_dwell=dwell,
        q_total_recovery=recovery,
        peak_jump=float(np.mean(jumps)),
        peak_jump_max=float(np.max(jumps)),
        peak_recovery=float(np.mean(later)),
        peak_force=float(series.peak[inside].max(initial=0.0)),
        saturation_inside=float((rotors | joints)[inside].sum() * period),
        saturation_outside=float((rotors | joints)[~inside].sum() * period),
        saturation_rotors=float(rotors[inside].sum() * period),
        relaxed_ticks=int(relaxed.sum()),
        failed_ticks=int(failed.sum()),
        slip=float(series.slip[inside].sum() * period),
        stops=tuple(setup.robot.tangent_names[k] for k in np.flatnonzero(stopped)),
        contacts=sum(w.touched for w in impacts),
        contacts_asked=task.count if isinstance(task, RepeatedContacts) else 1,
        rested=run.rested,
    )


def saturated(setup: Setup, series: Series) -> tuple[Flags, Flags]:
    """In which ticks a rotor's, and a joint's, command was at its limit; each of shape (n,)."""
    rotors: Flags = np.zeros(series.t.size, dtype=bool)
    propulsion = setup.robot.spec.propulsion
    if propulsion is not None:
        low, high = propulsion.speed_min, propulsion.speed_max
        near = _NEAR * (high - low)
        at_limit = (series.rotor_command <= low + near) | (series.rotor_command >= high - near)
        rotors = np.any(at_limit, axis=1)
    effort = np.asarray(setup.robot.model.effortLimit)[6 if setup.robot.floating else 0 :]
    limited = effort > 0
    joints: Flags = np.any(np.abs(series.torque[:, limited]) >= (1 - _NEAR) * effort[limited], axis=1)
    return rotors, joints


def before(series: Series, window: Window) -> int:
    """The last tick before a window begins."""
    return int(max(series.slice(window.begin, window.end).start - 1, 0))


def jump(setup: Setup, series: Series, window: Window) -> float:
    """Largest ``‖ν(t) − ν⁻‖`` within :data:`JUMP` of a window's begin; for pushes the largest ``‖ν‖`` within it."""
    hits = isinstance(setup.scenario.task, RepeatedContacts)
    return _peak(setup, series, window, window.begin + JUMP if hits else window.end)


def _peak(setup: Setup, series: Series, window: Window, end: float) -> float:
    """Largest ``‖ν(t) − ν⁻‖`` from a window's begin until ``end``; for pushes the largest ``‖ν‖``."""
    after = series.v[series.slice(window.begin, end)]
    if isinstance(setup.scenario.task, RepeatedContacts):
        after = after - series.v[before(series, window)]
    return float(np.linalg.norm(after, axis=1).max(initial=0.0))
