"""Metrics of a run: the metrics of the paper, and further metrics that are needed to interpret them."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from impact_posture.impact.evaluation.impact_effect import ImpactLoad, WorstJoint, impact_effect, mean_load
from impact_posture.simulation.run import Run
from impact_posture.simulation.series import RECOVERY, Array, Flags, Series, Window
from impact_posture.simulation.setup import Setup

# The velocity jump is measured until this time after the last contact of an impact has touched, s.
JUMP = 0.015
# Words in figures and tables for the time ``JUMP``.
AFTER_TOUCH = f"{1e3 * JUMP:g} ms of the touch (in a fall, of the last foot)"
# Words in figures and tables for the time window in which the recovery is measured.
UNTIL_RECOVERY = f"until {RECOVERY:g} s after each impact began"
# A command is saturated if its distance from a limit is below this share of the range.
_NEAR = 1e-3


@dataclass(frozen=True)
class Metrics:
    """Metrics of a run over all its contacts.

    Attributes:
        q_total_impact: ``∫‖ν‖dt`` over the impact windows (mixes m and rad, as in the paper).
        q_total_impact_base: Like ``q_total_impact``, but only with the six entries of the floating base.
        q_total_impact_joints: Like ``q_total_impact``, but only with the joints.
        q_total_dwell: ``∫‖ν‖dt`` over the dwell windows, 0 for pushes.
        q_total_recovery: ``∫‖ν‖dt`` over the recovery windows, which are long enough to contain delayed motions.
        peak_jump: Largest ``‖ν(t) − ν⁻‖`` within 15 ms after the first touch, averaged over the contacts (0 without
            contact).  If several contacts strike together, the 15 ms begin when the last contact touches, so that
            the impact is complete.  For pushes, the largest ``‖ν‖`` within the window.
        peak_jump_max: Like ``peak_jump``, but the largest value over the contacts.
        peak_recovery: Like ``peak_jump``, but within the whole recovery window.
        peak_force: Largest normal force within the impact windows, N.  For pushes, ``peak_force`` is the force of the
            push.
        saturation_inside: Time within the impact windows during which a rotor or a joint is at a control limit, s.
        saturation_outside: Like ``saturation_inside``, but outside the impact windows, s.
        saturation_rotors: Like ``saturation_inside``, but only for rotors, s.
        relaxed_ticks: Number of ticks in which the controller relaxed a level.
        failed_ticks: Number of ticks in which the controller repeated the last command.
        slip: Distance that the shape (for pushes, the fastest foot) slides within the impact windows, m.
        stops: Joints that reached a position limit within the impact windows and did not start at this limit.
        contacts: Number of contacts (or pushes) that happened.
        contacts_asked: Number of contacts (or pushes) that the scenario requests.
        rested: Whether the robot was at rest before the push or throw; true for contacts.
        base_linear: Largest change of the linear velocity of a floating base in the time interval of ``peak_jump``,
            averaged over the contacts, m/s.  ``None`` for a fixed base or if there was no contact.
        base_angular: Like ``base_linear``, but of the angular velocity, rad/s.
        joint: Joint with the largest change of velocity relative to its velocity limit, in the time interval of
            ``peak_jump`` of any contact.  ``None`` if there was no contact.
        impulse: Impulse of the contact along the normal in the time interval of ``peak_jump``, averaged over the
            contacts, N·s.  For pushes, the impulse of the push.
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
    base_linear: float | None = None
    base_angular: float | None = None
    joint: WorstJoint | None = None
    impulse: float = 0.0

    @property
    def load(self) -> ImpactLoad:
        """Effects of the impacts on base, joints and contact."""
        effect = self.base_linear, self.base_angular, self.joint
        return ImpactLoad(*effect, self.impulse, self.peak_force, self.peak_jump)

    def to_dict(self) -> dict[str, object]:
        """Return the JSON content, with the saturations in a separate table."""
        content = asdict(self)
        saturation = {key: content.pop(f"saturation_{key}") for key in ("inside", "outside", "rotors")}
        return {**content, "saturation_s": saturation}


def measure(setup: Setup, run: Run) -> Metrics:
    """Compute the metrics of a run."""
    series, impacts, contacts = run.series, run.of("impact"), setup.scenario.contacts
    inside: Flags = np.zeros(series.t.size, dtype=bool)
    for window in impacts:
        inside[series.slice(window.begin, window.end)] = True
    period = setup.scenario.control.period
    base = setup.robot.first_joint
    rotors, joints = saturated(setup, series)

    def integral(values: Array) -> float:
        return float(values.sum() * period)

    def distance(v: Array) -> float:
        return integral(np.linalg.norm(v, axis=1))

    def distance_in(kind: str) -> float:
        return sum(distance(series.v[series.slice(w.begin, w.end)]) for w in run.of(kind))

    # Leave out missed contacts, because they would appear as small impacts.
    loads = [impact_load(setup, series, w) for w in impacts if w.touched]
    load = mean_load(loads or [ImpactLoad(None, None, None, 0.0, 0.0, 0.0)])
    later = [_largest(setup, _change(setup, series, w, w.end)) for w in run.of("recovery") if w.touched] or [0.0]
    stopped = (series.at_stop[inside] & ~series.at_stop[0]).any(axis=0)
    return Metrics(
        q_total_impact=distance(series.v[inside]),
        q_total_impact_base=distance(series.v[inside, :base]),
        q_total_impact_joints=distance(series.v[inside, base:]),
        q_total_dwell=distance_in("dwell"),
        q_total_recovery=distance_in("recovery"),
        peak_jump=load.jump,
        peak_jump_max=max((each.jump for each in loads), default=0.0),
        peak_recovery=float(np.mean(later)),
        peak_force=float(series.peak[inside].max(initial=0.0)),
        saturation_inside=integral((rotors | joints)[inside]),
        saturation_outside=integral((rotors | joints)[~inside]),
        saturation_rotors=integral(rotors[inside]),
        relaxed_ticks=int(series.relaxed.sum()),
        failed_ticks=int(series.held.sum()),
        slip=integral(series.slip[inside]),
        stops=tuple(setup.robot.tangent_names[k] for k in np.flatnonzero(stopped)),
        contacts=sum(w.touched for w in impacts),
        contacts_asked=contacts.count if contacts else 1,
        rested=run.rested,
        base_linear=load.base_linear,
        base_angular=load.base_angular,
        joint=load.joint,
        impulse=load.impulse,
    )


def saturated(setup: Setup, series: Series) -> tuple[Flags, Flags]:
    """Return two arrays of shape (n,): whether a rotor, and whether a joint, was at a control limit in each tick."""
    rotors: Flags = np.zeros(series.t.size, dtype=bool)
    propulsion = setup.robot.spec.propulsion
    if propulsion is not None:
        low, high = propulsion.speed_min, propulsion.speed_max
        near = _NEAR * (high - low)
        at_limit = (series.rotor_command <= low + near) | (series.rotor_command >= high - near)
        rotors = np.any(at_limit, axis=1)
    joints: Flags = np.any(np.abs(series.torque) >= (1 - _NEAR) * setup.world.limits.effort, axis=1)
    return rotors, joints


def before(series: Series, window: Window) -> int:
    """Return the index of the last tick before a window begins."""
    return int(max(series.slice(window.begin, window.end).start - 1, 0))


def impact_load(setup: Setup, series: Series, window: Window) -> ImpactLoad:
    """Return the effects on base, joints and contact until :data:`JUMP` after the last contact has touched.

    The jump is the largest ``‖ν(t) − ν⁻‖`` in this interval, or for pushes, the largest ``‖ν‖`` within the window.
    The changes of base and joints are the largest changes in the same interval.  The peak force is the largest force
    in the window.
    """
    end = window.end if setup.scenario.push else window.begin + window.landing + JUMP
    inside = series.slice(window.begin, window.end)
    ticks, k = series.slice(window.begin, end), before(series, window)
    change = _change(setup, series, window, end)
    effect = impact_effect(setup.robot, change if len(change) else np.zeros(setup.robot.nv))
    impulse = series.impulse[max(ticks.stop - 1, k)] - series.impulse[k]
    # The second push or throw has the opposite direction.
    along = abs(float(setup.scenario.normal @ impulse))
    return ImpactLoad(
        **vars(effect),
        impulse=along,
        peak_force=float(series.peak[inside].max(initial=0.0)),
        jump=_largest(setup, change),
    )


def _change(setup: Setup, series: Series, window: Window, end: float) -> Array:
    """Return ``ν(t) − ν⁻``, or for pushes ``ν``, from the start of a window until ``end``, shape (ticks, nv)."""
    after = series.v[series.slice(window.begin, end)]
    return after if setup.scenario.push else after - series.v[before(series, window)]


def _largest(setup: Setup, change: Array) -> float:
    return float(np.linalg.norm(change[:, ~setup.robot.followers], axis=1).max(initial=0.0))
