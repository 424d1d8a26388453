"""The time that a robot needs along a path, within the limits of velocity, torque, thrust and friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from impact_posture.arrays import Array
from impact_posture.errors import InputError
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.curve import PathCurve
from impact_posture.path.path_space import PathSpace

# Time between two points of a trajectory, s, and the least number of points.
SAMPLE_TIME, _LEAST_POINTS = 0.01, 21
# Grid points of the time-optimal parametrization, and instants at which a floating robot is checked.
_GRID, INSTANTS = 400, 61
# Joint speed where the robot's data limit nothing, rad/s or m/s.
_DEFAULT_SPEED = 1.0
# From this share on, a limit is active.
_ACTIVE = 0.98
_ONE_AXIS = ("revolute", "continuous", "prismatic")


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


def velocity_limits(space: PathSpace) -> Array:
    """Return the velocity limits, shape (nv,), infinite where the model has none."""
    limits = np.array(space.model.velocityLimit)
    return np.where(np.isfinite(limits) & (limits > 0) & (limits < 1e10), limits, np.inf)


def time_optimal(space: PathSpace, curve: PathCurve, limits: ActuatorLimits) -> TimedCurve | None:
    """Return the fastest motion within velocities and torques (TOPP-RA, Pham and Pham 2018), ``None`` if none exists.

    For a fixed base with joints of one axis, whose torque limits are known.

    Raises:
        InputError: The package toppra is not installed.
    """
    try:
        from toppra import SplineInterpolator
        from toppra.algorithm import TOPPRA
        from toppra.constraint import DiscretizationType, JointTorqueConstraint, JointVelocityConstraint
    except ImportError:
        raise InputError(
            "the package toppra, which finds the fastest motion along a path, is not installed",
            where="the extra 'path'",
            hint="pip install 'impact-posture[path]'",
        ) from None
    speed, effort = velocity_limits(space), limits.effort
    # Joints without a limit get a bound that nothing reaches; the solver takes no infinities.
    bound = np.where(np.isfinite(speed), speed, 1e6)

    def used_torque(z: Array, v: Array, a: Array) -> Array:
        return limits.load(curve.at(z), v, a) / effort

    constraints = [
        JointVelocityConstraint(np.column_stack([-bound, bound])),
        JointTorqueConstraint(
            used_torque, np.tile([-1.0, 1.0], (len(effort), 1)), np.zeros(len(effort)),
            discretization_scheme=DiscretizationType.Interpolation,
        ),
    ]  # fmt: skip
    spline = SplineInterpolator(curve.s, curve.z)
    found = TOPPRA(constraints, spline, gridpoints=np.linspace(0.0, 1.0, _GRID + 1)).compute_trajectory()
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
    speed, known = velocity_limits(space), not limits.missing
    least = [0.0]
    if known:
        zero = np.zeros(space.model.nv)
        for q, v, a in rates:
            rest = limits.load(q, zero, zero)
            rate = limits.largest_rate(q, rest, limits.load(q, v, a) - rest)
            least.append(np.inf if not rate else rate**-0.5)
    if not np.isfinite(max(least)):
        known, least = False, [0.0]
        notes.append("torques, thrusts or friction cannot hold a posture of the path at rest: timed by velocities alone")
    elif limits.missing:
        notes.append(f"{limits.missing}: timed by velocities alone")
    if not known:
        speed = np.where(np.isfinite(speed), speed, _DEFAULT_SPEED)
        if not np.isfinite(velocity_limits(space)).all():
            notes.append(f"where no velocity limit is known, {_DEFAULT_SPEED:g} rad/s or m/s counts")
    duration = max(*least, *(float((np.abs(v) / speed).max()) for _, v, _ in rates), SAMPLE_TIME)
    t = _times(duration)
    motion = [_rates(curve, float(x)) for x in t / duration]
    return TimedCurve(
        t,
        curve.coordinates(_law(t / duration)[0]),
        np.array([v for _, v, _ in motion]) / duration,
        np.array([a for _, _, a in motion]) / duration**2,
        "scaled",
        tuple(notes),
    )


def timed(space: PathSpace, curve: PathCurve, limits: ActuatorLimits) -> TimedCurve:
    """Return the motion along a curve: time-optimal for a fixed base with known torques, else scaled.

    Raises:
        InputError: A package is not installed.
    """
    axes = all(slot.kind.family in _ONE_AXIS for slot in space.projector.chart.slots)
    if not limits.missing and axes and not space.problem.robot.floating:
        fastest = time_optimal(space, curve, limits)
        if fastest is not None:
            return fastest
    return scaled(space, curve, limits)


def limit_shares(space: PathSpace, motion: TimedCurve, postures: Array, limits: ActuatorLimits) -> dict[str, object]:
    """Return the largest shares of the limits along a motion, the joint or rotor of each, and the active limit."""
    robot = space.problem.robot
    speed = velocity_limits(space)
    used = (np.abs(motion.v) / speed).max(axis=0)
    found: dict[str, object] = {"velocity": float(used.max()), "velocity_of": robot.tangent_names[int(used.argmax())]}
    torque, thrust = [], []
    if not limits.missing:
        # A linear program an instant is only needed for forces that are not determined.
        every = range(len(motion.t)) if not robot.floating else _instants(len(motion.t))
        for k in every:
            shares = limits.shares(postures[k], limits.load(postures[k], motion.v[k], motion.a[k]))
            if shares is not None:
                torque.append(shares.torque)
                thrust.append(shares.thrust)
    joints = robot.tangent_names[6 if robot.floating else 0 :]
    rotors = [r.name for r in robot.spec.propulsion.rotors] if robot.spec.propulsion else []
    for name, values, names in (("torque", torque, joints), ("thrust", thrust, rotors)):
        largest = np.max(values, axis=0) if values and len(values[0]) else None
        found[name] = None if largest is None else float(largest.max())
        found[f"{name}_of"] = None if largest is None else names[int(largest.argmax())]
    sizes = {name: float(found[name] or 0.0) for name in ("velocity", "torque", "thrust")}  # type: ignore[arg-type]
    most = max(sizes, key=lambda name: sizes[name])
    friction = bool(space.problem.objective.supports) and not limits.missing and not motion.notes
    found["active"] = most if sizes[most] > _ACTIVE else "friction" if friction else None
    return found


def _instants(count: int) -> list[int]:
    return sorted({round(k) for k in np.linspace(0, count - 1, INSTANTS)})


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
