"""Timing of a path within the limits of velocity, torque, thrust and friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.path_curve import PathCurve
from impact_posture.path.path_space import PathSpace
from impact_posture.path.speed_profile import slowed
from impact_posture.path.stroke import SHARE
from impact_posture.path.time_law import polynomial, stepped
from impact_posture.path.timed_curve import SAMPLE_TIME, TimedCurve, moment, sampled
from impact_posture.system.arrays import Array

# Number of intervals of the time-optimal parametrization.  Within an interval, a motion can exceed a limit by up to 1
# %.
_GRID = 400
# Number of evenly spaced instants at which a scaled motion is checked.
INSTANTS = 61
# Number of rows of a table of ``s`` over time.
_INVERSE = 2001
# Velocity limit that is assumed for a joint without a velocity limit, rad/s or m/s.
_DEFAULT_SPEED = 1.0
# A limit is active if a motion needs more than this share of the limit.
_ACTIVE = 0.98
_ONE_AXIS = ("revolute", "continuous", "prismatic")
# A time-optimal motion is rejected if it needs more than this multiple of any limit.
_EXCEEDED = 1.01
# A motion that does not end at rest keeps its speed along the curve for this time before its end, s.
_STEADY = 5e-3
# A controller permits no acceleration that would reach a velocity limit within the time ``1/RATE``, s
# (:attr:`impact_posture.tsid.limits.acceleration_bounds.LimitLaw.rate`).
RATE = 50.0
# Coefficients of 6 τ⁵ − 15 τ⁴ + 10 τ³, highest power first.
_SMOOTH = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])


def time_optimal(
    space: PathSpace, curve: PathCurve, limits: ActuatorLimits, place: float = np.inf, rate: float = 0.0
) -> TimedCurve | None:
    """Return the fastest motion within velocity and torque limits (TOPP-RA, Pham and Pham 2018), or ``None``.

    The robot must have a fixed base, joints of one degree of freedom, and known torque limits.  The function also
    returns ``None`` if the motion exceeds limits between the points of its grid.

    The motion ends with ``ṡ = rate``, and ``ṡ`` is at most ``rate`` from ``s = place`` on.  If ``rate`` is not zero,
    the motion leaves a part of the torques to the controller (:data:`~impact_posture.path.stroke.SHARE`), and its
    accelerations are within the bounds of the controller, ``|q̈_i| ≤ RATE (v̄_i − |q̇_i|)``.  TOPP-RA needs bounds that
    are linear in ``q̈`` and ``q̇²``.  So the motion satisfies the stricter ``(q̇_i/v̄_i)² + 2|q̈_i|/(RATE v̄_i) ≤ 1``.
    """
    from toppra import SplineInterpolator
    from toppra.algorithm import TOPPRA
    from toppra.constraint import DiscretizationType, JointVelocityConstraintVarying, SecondOrderConstraint

    if not topp_ra_times(space, limits):
        return None

    speed = space.problem.robot.velocity_limits
    # The solver does not accept infinite limits.
    bound = np.where(np.isfinite(speed), speed, 1e6)

    def used(z: Array, v: Array, a: Array) -> Array:
        q = curve.at(z)
        shares = limits.shares(q, limits.load(q, v, a))
        assert shares is not None  # noqa: S101 (a fixed base balances every load)
        if not rate:
            return shares
        square, rise = (v / bound) ** 2, 2 * a / (RATE * bound)
        return np.concatenate([shares / SHARE, square + rise, square - rise])

    # The parameter is the path length, so that the derivative of the posture with respect to the parameter has
    # norm 1.  TOPP-RA loses digits if this norm is far from 1.
    size = space.length([curve.at(z) for z in curve.z])
    ends = tuple(end if isinstance(end, str) else (1, end[1] / size) for end in curve.ends)
    spline = SplineInterpolator(size * curve.s, curve.z, bc_type=ends)

    def speeds(x: float) -> Array:
        # The largest share of a velocity limit at this rate.
        share = size * rate * float((np.abs(spline(x, 1)) / bound).max())
        arrives = x >= size * (place - 1 / _GRID)
        return (min(share, 1.0) if arrives else 1.0) * np.column_stack([-bound, bound])

    count = len(used(curve.z[0], *np.zeros((2, space.model.nv))))
    sides = np.vstack([np.eye(count), -np.eye(count)])
    constraints = [
        JointVelocityConstraintVarying(speeds),
        SecondOrderConstraint(
            used, lambda _: sides, lambda _: np.ones(2 * count), space.model.nv,
            discretization_scheme=DiscretizationType.Interpolation,
        ),
    ]  # fmt: skip
    places = np.linspace(0.0, 1.0 - _STEADY * rate, _GRID + 1)
    places = np.append(places, [1.0] if rate else [])
    planner = TOPPRA(constraints, spline, gridpoints=size * places)
    rates = planner.compute_parameterization(0.0, size * rate)[1]
    if rates is None or not np.isfinite(rates).all():
        return None
    rates = rates / size
    if rate:
        if not np.allclose(rates[-2:], rate, rtol=1e-6):
            return None
        rates[-2:] = rate
    motion = sampled(space, curve, limits, stepped(places, rates), "time-optimal")
    return motion if _exceeded(space, motion, limits) <= _EXCEEDED else None


def scaled(space: PathSpace, curve: PathCurve, limits: ActuatorLimits, jobs: int = 1) -> TimedCurve:
    """Return the fastest motion of the form ``s(t) = 10 τ³ − 15 τ⁴ + 6 τ⁵``, ``τ = t/T``, within all known limits.

    The load of a motion is the load of gravity plus ``1/T²`` times a load that does not depend on ``T``.  So a linear
    program gives the smallest ``T`` at each instant, and the motion takes the largest ``T`` of all instants.  The
    instants are evenly spaced, with additional instants at ``curve.places``, most of which are at corners.  If a
    curve has corners and :func:`slowed` takes less time, the result is the slowed motion.
    """
    fine, law = np.linspace(0.0, 1.0, _INVERSE), polynomial(_SMOOTH, 1.0)
    notes, tau = [], np.concatenate([np.linspace(0.0, 1.0, INSTANTS), np.interp(curve.places, law.at(fine)[0], fine)])
    rates = [moment(curve, law, x) for x in tau.tolist()]
    speed, known = space.problem.robot.velocity_limits, not limits.missing
    least = np.zeros(len(tau))
    slower = slowed(space, curve, limits, jobs) if known and curve.corners.any() else None
    if known:
        zero, largest = np.zeros(space.model.nv), list[float | None]()
        rests = [(q, limits.load(q, zero, zero)) for q, _, _ in rates]
        for (q, v, a), (_, rest) in zip(rates, rests, strict=True):
            largest.append(limits.largest_rate(q, rest, limits.load(q, v, a) - rest))
            # The remaining instants can only make the scaled motion longer.
            if slower is not None and largest[-1] and largest[-1] ** -0.5 > slower.rows.t[-1]:
                return slower
        known = all(largest)
        least = np.array([rate**-0.5 if rate else 0.0 for rate in largest])
    if not known:
        why = limits.missing or _cannot_move(space, limits, rests)
        notes.append(f"{why}: timed by velocities alone")
        least[:] = 0.0
        speed = np.where(np.isfinite(speed), speed, _DEFAULT_SPEED)
        if not np.isfinite(space.problem.robot.velocity_limits).all():
            notes.append(f"where no velocity limit is known, {_DEFAULT_SPEED:g} rad/s or m/s is assumed")
    least = np.maximum(least, [float((np.abs(v) / speed).max()) for _, v, _ in rates])
    duration = max(float(least.max()), SAMPLE_TIME)
    if known and slower is not None and slower.rows.t[-1] < duration:
        return slower
    return sampled(space, curve, limits, polynomial(_SMOOTH, duration), "scaled", tuple(notes))


def _cannot_move(space: PathSpace, limits: ActuatorLimits, loads: Sequence[tuple[Array, Array]]) -> str:
    """Return why the limits allow no speed on a path, from its postures and their loads at rest."""
    shares = [limits.shares(q, load) for q, load in loads]
    held = [share for share in shares if share is not None]
    if len(held) < len(shares):
        return "rotors or friction cannot hold all postures of the path at rest"
    worst = np.abs(held).max(axis=0)
    if worst.max() <= 1:
        return "rotors or friction cannot accelerate the robot along the path at any speed"
    return f"{limits.names[int(worst.argmax())]} would need {worst.max():.3g} times its limit at rest on the path"


def timed(space: PathSpace, curve: PathCurve, limits: ActuatorLimits, jobs: int = 1) -> TimedCurve:
    """Return the motion along a curve: time-optimal for a fixed base with known torque limits, else scaled.

    If a time-optimal motion exceeds limits between the points of its grid, the slowed motion replaces it.
    """
    motion = time_optimal(space, curve, limits)
    if motion is None and topp_ra_times(space, limits):
        motion = slowed(space, curve, limits, jobs)
    return scaled(space, curve, limits, jobs) if motion is None else motion


def topp_ra_times(space: PathSpace, limits: ActuatorLimits) -> bool:
    """Return whether TOPP-RA can time the robot: fixed base, joints of one axis, and known torque limits."""
    axes = all(slot.kind.family in _ONE_AXIS for slot in space.projector.chart.slots)
    return not limits.missing and axes and not space.problem.robot.floating


def _exceeded(space: PathSpace, motion: TimedCurve, limits: ActuatorLimits) -> float:
    """Return the largest share of a limit that a motion with a fixed base needs, at its rows and between them."""
    speeds = space.problem.robot.velocity_limits
    return max(limits.need(motion.rows.at(t), speeds).share for t in motion.instants)


@dataclass(frozen=True, eq=False)
class LimitUse:
    """Largest shares of the limits that a motion needs at each time, shape (m,); 1 means that it reaches a limit.

    The share of a thrust is its distance from the middle of its range, divided by half the range.  Unknown torques
    and thrusts are NaN.  ``largest`` contains the largest shares, the actuators that need them, and the active limit,
    as in ``result.json``.
    """

    at: Array
    velocity: Array
    torque: Array
    thrust: Array
    largest: dict[str, object]


def limit_use(space: PathSpace, motion: TimedCurve, limits: ActuatorLimits) -> LimitUse:
    """Return the shares of the limits along a motion, at its rows and between rows.

    Forces of feet and of more than six rotors are not unique.  The function chooses the forces for which the largest
    share of a limit is smallest.
    """
    robot, t = space.problem.robot, motion.instants
    moments = [motion.rows.at(time) for time in t]
    if robot.floating:
        # Each instant needs a linear program.  Check only evenly spaced instants, and the instants of largest
        # acceleration.
        even = [round(k) for k in np.linspace(0, len(t) - 1, INSTANTS)]
        bent = np.argsort([-np.abs(a).max() for _, _, a in moments], kind="stable")[:INSTANTS].tolist()
        every = sorted({*even, *bent})
        t, moments = t[every], [moments[k] for k in every]
    shares = np.full((len(t), len(limits.names)), np.nan)
    for row, moment_ in enumerate([] if limits.missing else moments):
        needed = limits.shares(moment_[0], limits.load(*moment_))
        shares[row] = np.nan if needed is None else needed
    groups = {"velocity": (np.abs([v for _, v, _ in moments]) / robot.velocity_limits, robot.tangent_names)}
    for kind in ("torque", "thrust"):
        columns = [k for k, other in enumerate(limits.kinds) if other == kind]
        groups[kind] = np.abs(shares[:, columns]), tuple(limits.names[k] for k in columns)
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
        used.max(axis=1) if used.shape[1] else np.full(len(t), np.nan) for used, _ in groups.values()
    )
    return LimitUse(t, velocity, torque, thrust, largest)
