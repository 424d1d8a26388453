"""The time that a robot needs along a path, within the limits of velocity, torque, thrust and friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.impact.objective import Objective
from impact_posture.path.curve import PathCurve
from impact_posture.path.path_space import PathSpace
from impact_posture.posture.load_cases import load_cases
from impact_posture.posture.problem import Requirements

# Time between two points of a trajectory, s, and the least number of points.
SAMPLE_TIME, _LEAST_POINTS = 0.01, 21
# Intervals of the time-optimal parametrization, within which a limit may be exceeded by less than 1 %.
_GRID = 400
# Instants at which a scaled motion is checked.
INSTANTS = 61
# Joint speed where the robot's data limit nothing, rad/s or m/s.
_DEFAULT_SPEED = 1.0
# From this share on, a limit is active.
_ACTIVE = 0.98
_ONE_AXIS = ("revolute", "continuous", "prismatic")
# Least part of the weight that counts as a wrench on the base that the rotors cannot make.
_UNREACHABLE = 1e-7


class ActuatorLimits:
    """Limits on the load ``M ν̇ + h`` of a motion, from what holds the robot at rest.

    Motors, rotors and feet are those of :class:`~impact_posture.posture.equilibrium.Equilibrium`, which moves here.

    Args:
        objective: The objective, with the robot and its supports.
        q: A posture with the feet in place, shape (nq,).
        requirements: The friction of the feet.

    Attributes:
        names: Names of the actuators with a limit.
        kinds: Kind of each: ``torque`` or ``thrust``.
        missing: Why the limits of this robot are not known; empty if they are.
    """

    def __init__(self, objective: Objective, q: Array, requirements: Requirements) -> None:
        robot = objective.robot
        self._model = robot.model.copy()
        # The rotors move with their joints, whatever an impact meets of them.
        self._model.armature = np.where(np.isfinite(robot.armature), robot.armature, 0.0)
        self._data = self._model.createData()
        found = load_cases(objective, q, replace(requirements, hold_force=0.0))
        self.missing = found.unknown
        self.names: tuple[str, ...] = ()
        self.kinds: tuple[str, ...] = ()
        if found.cases:
            self._held, unreachable = found.cases[0].equilibrium, found.cases[0].unreachable
            self._unreachable = unreachable / self._held.weight
            self.names, self.kinds = self._held.actuators, self._held.kinds

    def load(self, q: Array, v: Array, a: Array) -> Array:
        """Return the generalized forces of a motion, ``M ν̇ + h``, shape (nv,), by RNEA with gravity and armature."""
        return np.array(pin.rnea(self._model, self._data, q, v, a))

    def largest_rate(self, q: Array, rest: Array, dynamic: Array) -> float | None:
        """Return the largest ``λ ≥ 0`` for which the limits allow the load ``rest + λ dynamic``; infinite if all do.

        A motion that takes the time ``T`` has the load of gravity and ``1/T²`` times that of ``T = 1 s``.  So this is
        the least duration at a posture.  ``None`` if the limits do not even allow the load at rest.
        """
        if self._out_of_reach(rest):
            return None
        return 0.0 if self._out_of_reach(rest + dynamic) else self._held.largest_rate(q, rest, dynamic)

    def shares(self, q: Array, load: Array) -> Array | None:
        """Return the signed shares of the limits that a load takes, the largest as small as possible, by name.

        A share is 0 in the middle of the range of an actuator, and ±1 at its limits.  ``None`` if rotors or friction
        do not allow the load.
        """
        return None if self._out_of_reach(load) else self._held.shares(q, load)

    def _out_of_reach(self, load: Array) -> bool:
        wrench = self._unreachable @ load[: self._unreachable.shape[1]] if len(self._unreachable) else np.zeros(0)
        return bool(np.abs(wrench).max(initial=0.0) > _UNREACHABLE)


@dataclass(frozen=True, eq=False)
class TimedCurve:
    """A motion along a curve.

    Attributes:
        t: Times, s, shape (n,).
        z: Tangent coordinates on the curve, shape (n, nv).
        v: Velocities ``ν``, shape (n, nv).
        a: Accelerations ``ν̇``, shape (n, nv).
        method: ``time-optimal`` (fixed base) or ``scaled`` (one time scale for the whole motion).
        notes: What the motion does not respect, and why.
    """

    t: Array
    z: Array
    v: Array
    a: Array
    method: str
    notes: tuple[str, ...] = ()


def time_optimal(space: PathSpace, curve: PathCurve, limits: ActuatorLimits) -> TimedCurve | None:
    """Return the fastest motion within velocities and torques (TOPP-RA, Pham and Pham 2018), ``None`` if none exists.

    For a fixed base with joints of one axis, whose torque limits are known.
    """
    from toppra import SplineInterpolator
    from toppra.algorithm import TOPPRA
    from toppra.constraint import DiscretizationType, JointTorqueConstraint, JointVelocityConstraint

    speed = space.problem.robot.velocity_limits
    # Joints without a limit get a bound that nothing reaches; the solver takes no infinities.
    bound = np.where(np.isfinite(speed), speed, 1e6)

    # TOPP-RA needs a torque for every joint.  That of a joint without a limit stays zero.
    count, limited = space.model.nv, len(limits.names)

    def used(z: Array, v: Array, a: Array) -> Array:
        q = curve.at(z)
        found = limits.shares(q, limits.load(q, v, a))
        assert found is not None  # noqa: S101 (a fixed base balances every load)
        return np.concatenate([found, np.zeros(count - limited)])

    constraints = [
        JointVelocityConstraint(np.column_stack([-bound, bound])),
        JointTorqueConstraint(
            used, np.tile([-1.0, 1.0], (count, 1)), np.zeros(count),
            discretization_scheme=DiscretizationType.Interpolation,
        ),
    ]  # fmt: skip
    # By path length, because TOPP-RA loses digits where the speed along the path is far from 1.
    size = space.length([curve.at(z) for z in curve.z])
    planner = TOPPRA(
        constraints, SplineInterpolator(size * curve.s, curve.z), gridpoints=np.linspace(0.0, size, _GRID + 1),
        # The default, a spline over time, exceeds the torques by a quarter where they switch.
        parametrizer="ParametrizeConstAccel",
    )  # fmt: skip
    found = planner.compute_trajectory()
    if found is None:
        return None
    t = _times(float(found.duration))
    z, v, a = (np.asarray(found(t, order)) for order in range(3))
    return TimedCurve(t, z, v, a, "time-optimal")


def scaled(space: PathSpace, curve: PathCurve, limits: ActuatorLimits) -> TimedCurve:
    """Return the fastest motion of the form ``s(t) = 10 τ³ − 15 τ⁴ + 6 τ⁵``, ``τ = t/T``, within all known limits.

    The load of a motion is that of gravity and ``1/T²`` times a load that does not depend on ``T``.  So a linear
    program at each instant gives the least ``T`` there, and the largest of them counts.
    """
    notes, tau = [], np.linspace(0.0, 1.0, INSTANTS)
    rates = [_rates(curve, float(x)) for x in tau]
    speed, known = space.problem.robot.velocity_limits, not limits.missing
    if known:
        zero = np.zeros(space.model.nv)
        rests = [(q, limits.load(q, zero, zero)) for q, _, _ in rates]
        found = [
            limits.largest_rate(q, rest, limits.load(q, v, a) - rest)
            for (q, v, a), (_, rest) in zip(rates, rests, strict=True)
        ]
        known = all(found)
        least = [rate**-0.5 for rate in found if rate]
    if not known:
        why = limits.missing or _cannot_move(space, limits, rests)
        notes.append(f"{why}: timed by velocities alone")
        least = [0.0]
        speed = np.where(np.isfinite(speed), speed, _DEFAULT_SPEED)
        if not np.isfinite(space.problem.robot.velocity_limits).all():
            notes.append(f"where no velocity limit is known, {_DEFAULT_SPEED:g} rad/s or m/s counts")
    duration = max(*least, *(float((np.abs(v) / speed).max()) for _, v, _ in rates), SAMPLE_TIME)
    t = _times(duration)
    motion = [_rates(curve, float(x)) for x in t / duration]
    return TimedCurve(
        t,
        curve.spline(_law(t / duration)[0]),
        np.array([v for _, v, _ in motion]) / duration,
        np.array([a for _, _, a in motion]) / duration**2,
        "scaled",
        tuple(notes),
    )


def _cannot_move(space: PathSpace, limits: ActuatorLimits, loads: Sequence[tuple[Array, Array]]) -> str:
    """Say why the limits allow no speed on a path, from its postures and their loads at rest."""
    shares = [limits.shares(q, load) for q, load in loads]
    held = [share for share in shares if share is not None]
    if len(held) < len(shares):
        return "rotors or friction cannot hold all postures of the path at rest"
    worst = np.abs(held).max(axis=0)
    if worst.max() <= 1:
        return "rotors or friction cannot accelerate the robot along the path at any speed"
    return f"{limits.names[int(worst.argmax())]} would need {worst.max():.3g} times its limit at rest on the path"


def timed(space: PathSpace, curve: PathCurve, limits: ActuatorLimits) -> TimedCurve:
    """Return the motion along a curve: time-optimal for a fixed base with known torques, else scaled."""
    axes = all(slot.kind.family in _ONE_AXIS for slot in space.projector.chart.slots)
    if not limits.missing and axes and not space.problem.robot.floating:
        fastest = time_optimal(space, curve, limits)
        if fastest is not None:
            return fastest
    return scaled(space, curve, limits)


@dataclass(frozen=True, eq=False)
class LimitUse:
    """The shares of the limits that a motion takes over time; 1 is at a limit.

    Attributes:
        at: Times, s, shape (m,).
        velocity: Largest share of a velocity limit at each time, shape (m,).
        torque: Largest share of a torque limit, NaN where not known, shape (m,).
        thrust: Largest share of half of a thrust's range, from its middle, NaN where not known, shape (m,).
        largest: Largest shares, whose they are, and the active limit, as in ``result.json``.
    """

    at: Array
    velocity: Array
    torque: Array
    thrust: Array
    largest: dict[str, object]


def limit_use(space: PathSpace, motion: TimedCurve, postures: Array, limits: ActuatorLimits) -> LimitUse:
    """Return the shares of the limits along a motion with its postures on the constraints, shape (n, nq).

    Forces of feet and of more than six rotors are not determined: those count whose largest share is least.
    """
    robot, count = space.problem.robot, len(motion.t)
    # A floating robot takes a linear program an instant.
    every = sorted({round(k) for k in np.linspace(0, count - 1, INSTANTS)}) if robot.floating else list(range(count))
    shares = np.full((len(every), len(limits.names)), np.nan)
    for row, k in enumerate([] if limits.missing else every):
        found = limits.shares(postures[k], limits.load(postures[k], motion.v[k], motion.a[k]))
        shares[row] = np.nan if found is None else found
    groups = {"velocity": (np.abs(motion.v[every]) / space.problem.robot.velocity_limits, robot.tangent_names)}
    for kind in ("torque", "thrust"):
        own = [k for k, other in enumerate(limits.kinds) if other == kind]
        groups[kind] = np.abs(shares[:, own]), tuple(limits.names[k] for k in own)
    largest: dict[str, object] = {}
    sizes: dict[str, float] = {}
    for name, (used, names) in groups.items():
        known = bool(np.isfinite(used).any())
        place = int(np.nanargmax(used)) % used.shape[1] if known else 0
        sizes[name] = float(np.nanmax(used)) if known else 0.0
        largest |= {name: sizes[name] if known else None, f"{name}_of": names[place] if known else None}
    most = max(sizes, key=lambda name: sizes[name])
    standing = bool(space.problem.objective.supports) and not motion.notes
    largest["active"] = most if sizes[most] > _ACTIVE else "friction" if standing else None
    velocity, torque, thrust = (
        used.max(axis=1) if used.shape[1] else np.full(len(every), np.nan) for used, _ in groups.values()
    )
    return LimitUse(motion.t[every], velocity, torque, thrust, largest)


def _times(duration: float) -> Array:
    return np.linspace(0.0, duration, max(_LEAST_POINTS, int(np.ceil(duration / SAMPLE_TIME)) + 1))


def _law(tau: Array) -> tuple[Array, Array, Array]:
    """Return ``s(τ)`` and its two derivatives: at rest without acceleration at both ends."""
    return (
        tau**3 * (10 - 15 * tau + 6 * tau**2),
        30 * tau**2 * (1 - tau) ** 2,
        60 * tau * (1 - tau) * (1 - 2 * tau),
    )


def _rates(curve: PathCurve, tau: float) -> tuple[Array, Array, Array]:
    """Return posture, velocity and acceleration of the motion that takes 1 s."""
    s, ds, dds = (float(x) for x in _law(np.array(tau)))
    v = curve.velocity(s)
    return curve.posture(s), v * ds, curve.acceleration(s) * ds**2 + v * dds
