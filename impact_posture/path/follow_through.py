"""The motion after the impact of a strike: from the predicted state, or from a similar state, to rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pinocchio as pin

from impact_posture.config.json_block import jsonable
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.friction.contact_impulses import contact_impulses
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case.worst_normal import cone_axes
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.path_space import PathSpace
from impact_posture.path.row_interpolation import Moment, RowInterpolation
from impact_posture.path.strike_spaces import StrikeSpaces, landed
from impact_posture.path.stroke import shortest_stroke
from impact_posture.path.timed_curve import moment, sampled
from impact_posture.posture.constraints.clearance import Clearance
from impact_posture.posture.formulation.landing import falls_freely
from impact_posture.posture.program.certificate import linearized_limits
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.system.arrays import Array
from impact_posture.system.processes import fork_map

# Coefficients of restitution of the considered impacts (:attr:`FollowThrough.impacts`).
RESTITUTIONS = (0.0, 0.5)
# Factors that multiply the velocity before the impact, for the considered impacts.
FACTORS = (0.8, 1.0, 1.2)
# Number of normals on the edge of the cone.
_EDGE = 4
# Number of postures of a stop at which distances are measured.
_POSTURES = 12
# Feet are on level ground if the heights of their corners differ by less than this value, m.
_LEVEL = 1e-3


@dataclass(frozen=True)
class Room:
    """The least distance along all stops, rad or m, with the joint or bodies (``of``) and the ``impact``."""

    distance: float
    of: str
    impact: str


@dataclass(frozen=True, eq=False)
class FollowThrough:
    """The stop after the predicted impact, and the least distances along the stops after all considered impacts.

    Attributes:
        velocity: Predicted generalized velocity after the impact, ``ν + Δν``, shape (nv,); ``ν`` if no impulse is
            known.
        rows: The stop: the motion from ``velocity`` to rest; ``None`` if no stop exists.
        impacts: Number of considered impacts: the predicted impact, and all combinations of a restitution in
            :data:`RESTITUTIONS` (0 after a fall), a factor on the velocity in :data:`FACTORS`, and a normal (also on
            the edge of the cone of normals).
        stopped: Number of the considered impacts after which a stop within the limits exists.
        longest_s: Duration of the longest stop, s.
        joints: Least distance from a joint limit; ``None`` without limits.
        clearance: Least distance between links and other bodies minus the clearance; ``None`` without shapes.
        hindrance: What prevents a stop, and after which impact; empty if all stops exist.
        center_of_pressure: Least distance of the center of pressure from an edge of the support polygon; ``None``
            without feet that span an area on level ground.
    """

    velocity: Array
    rows: RowInterpolation | None
    impacts: int
    stopped: int
    longest_s: float
    joints: Room | None
    clearance: Room | None
    hindrance: str = ""
    center_of_pressure: Room | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the fields as JSON content, without ``rows``."""
        duration = None if self.rows is None else float(self.rows.t[-1])
        content = {key: value for key, value in vars(self).items() if key != "rows"}
        return jsonable({"duration_s": duration, **content})  # type: ignore[no-any-return]


def after_impact(
    problem: ConstrainedProblem, spaces: StrikeSpaces, q: Array, velocity: Array, restitution: float
) -> Array | None:
    """Return ``ν + (1 + e) M⁻¹Jᵀp``, shape (nv,), with the impulses ``p`` of a plastic impact with friction.

    All contacts strike at the same time.  The velocity before the impact need not be along the normals.  Return
    ``None`` if the iteration for ``p`` does not converge.
    """
    impact = problem.impact
    J = np.vstack([single.oracle.at(q).J for single in impact.singles])
    responses = impact.oracle.at(q).solve(J.T)
    friction = np.array([contact.friction for contact in impact.contacts])
    p = contact_impulses(J @ responses, (J @ velocity).reshape(-1, 3), spaces.normals, friction)
    return None if p is None else velocity + (1 + restitution) * responses @ p.ravel()


def follow_through(
    problem: ConstrainedProblem,
    q: Array,
    velocity: Array,
    restitution: float,
    limits: ActuatorLimits,
    jobs: int = 1,
) -> FollowThrough:
    """Return the stop after the impact at ``q`` with the velocity ``ν``, shape (nv,), within the limits.

    Held joints and feet are assumed not to move.  The velocity after the impact may exceed the limits.  ``jobs``
    processes compute the stops.

    A robot that falls (:func:`~impact_posture.posture.formulation.landing.falls_freely`) then stands on its
    contacts, and ``limits`` are the limits of the standing robot
    (:func:`~impact_posture.path.strike_spaces.landed`).  After a fall, only plastic impacts are considered, because
    the leg of a foot that rebounds presses the foot onto the ground again.
    """
    falls = falls_freely(problem.objective, problem.requirements.base)
    standing, restitutions = (landed(problem, q), (0.0,)) if falls else (problem, RESTITUTIONS)
    spaces = StrikeSpaces(standing, q)
    around, cone, axes = {"": spaces}, np.deg2rad(problem.impact.normal_cone_deg), cone_axes(spaces.normals[0])
    for k in range(_EDGE if cone > 0 else 0):
        angle = 2 * np.pi * k / _EDGE
        tilted = axes @ [np.cos(cone), np.sin(cone) * np.cos(angle), np.sin(cone) * np.sin(angle)]
        x, y, z = np.round(tilted, 3) + 0.0
        around[f", normal {x:g} {y:g} {z:g}"] = StrikeSpaces(standing, q, normals=tilted[None])
    spread = product(restitutions, FACTORS, around.items())
    impacts = {"the predicted impact": (spaces, 1.0, 0.0 if falls else restitution)} | {
        f"restitution {e:g}, {factor:.0%} of the speed{where}": (at, factor, e) for e, factor, (where, at) in spread
    }
    names, cases = list(impacts), list(impacts.values())

    def stop_after(k: int) -> tuple[Array | None, _Stop | str]:
        """Return the velocity after impact ``k``, and the stop or the reason why no stop exists."""
        at, factor, e = cases[k]
        state = after_impact(problem, at, q, factor * velocity, e)
        if state is None:
            return state, "no impulse is known"
        return state, _stop(names[k], at, q, state, limits, falls, sample=not k)

    with fork_map(stop_after, len(cases), jobs) as results:
        ends = [result for _, result in sorted(results, key=lambda pair: pair[0])]
    state, first = ends[0]
    stops = [stop for _, stop in ends if isinstance(stop, _Stop)]
    missed = (f"{stop}, after {name}" for name, (_, stop) in zip(names, ends, strict=True) if isinstance(stop, str))
    rows = (
        None if isinstance(first, str) or first.rows is None else RowInterpolation(spaces.rebound.model, *first.rows)
    )
    return FollowThrough(
        velocity=velocity if state is None else state,
        rows=rows,
        impacts=len(impacts),
        stopped=len(stops),
        longest_s=max((stop.duration for stop in stops), default=0.0),
        joints=_least(stops, lambda moment: _to_limits(spaces.rebound, moment[0])),
        clearance=_least(stops, lambda moment: _to_bodies(spaces.rebound, moment[0])),
        hindrance=next(missed, ""),
        center_of_pressure=_least(stops, _to_edges(standing, q, limits)),
    )


@dataclass(frozen=True, eq=False)
class _Stop:
    """A stop after the impact with the name ``impact``; ``duration`` is its shortest duration before rounding, s.

    ``moments`` are evenly spaced in time.  ``rows`` are ``t, q, v, a`` of :class:`RowInterpolation`, if requested.
    """

    impact: str
    duration: float
    moments: list[Moment]
    rows: tuple[Array, Array, Array, Array] | None


def _stop(
    impact: str, spaces: StrikeSpaces, q: Array, velocity: Array, limits: ActuatorLimits, falls: bool, sample: bool
) -> _Stop | str:
    """Return the shortest stop from a velocity, or the reason why no stop exists.

    Along the curve of the stop, the normal velocities of the contact points are proportional to its speed, so contact
    points move away from their surfaces.  If the robot falls, the velocity of its center of mass is constant instead,
    so the ground need not pull the feet.  If its feet slide after the impact, impulses at the feet first stop them.
    The velocity of a held joint is set to zero.
    """
    if falls and limits.missing:
        return f"no stop exists, because {limits.missing}"
    space = spaces.rebound
    numeric = Numeric(space.model).at(q)
    held = equality_jacobian(space.problem, numeric)
    # With W = LLᵀ, the nearest velocity in the metric W that holds the constraints is ν − L⁻ᵀ(H L⁻ᵀ)⁺Hν.  After a
    # fall, W is the mass matrix.  Else, W is the identity, so that held joints do not change the other joints.
    factor = np.linalg.cholesky(numeric.mass_matrix()) if falls else np.eye(space.model.nv)
    impulses = np.linalg.pinv(np.linalg.solve(factor, held.T).T, rcond=1e-9) @ (held @ velocity)
    velocity = velocity - np.linalg.solve(factor.T, impulses)

    def rows(model: Numeric) -> Array:
        return np.vstack([equality_jacobian(space.problem, model), model.center_of_mass()[1]])

    along = rows if falls else spaces.rows(space)
    stroke, duration = shortest_stroke(space, q, velocity, along, limits, before=False)
    if stroke.curve is None:
        return f"no stop along the velocity exists, because of {stroke.end}"
    if duration is None:
        return f"no stop along the velocity exists, because of {stroke.hindrance(limits, 1.0)}"
    law = stroke.law(duration)
    moments = [moment(stroke.curve, law, t) for t in np.linspace(0.0, law.duration, _POSTURES).tolist()]
    rows_ = sampled(space, stroke.curve, limits, law, "").rows if sample else None
    return _Stop(impact, duration, moments, None if rows_ is None else (rows_.t, rows_.q, rows_.v, rows_.a))


def _least(stops: Sequence[_Stop], distance: Callable[[Moment], tuple[float, str]]) -> Room | None:
    rooms = [Room(*distance(moment), stop.impact) for stop in stops for moment in stop.moments]
    least = min(rooms, key=lambda room: room.distance, default=None)
    return least if least is not None and np.isfinite(least.distance) else None


def _to_limits(space: PathSpace, q: Array) -> tuple[float, str]:
    """Return the least distance from a joint limit, rad or m, and the joint; infinity without limits."""
    rows, names = linearized_limits(space.problem, q), space.problem.robot.tangent_names
    distances = np.minimum(rows.value - rows.lower, rows.upper - rows.value)
    movable = zip(distances.tolist(), rows.posture.argmax(axis=1).tolist(), rows.lower < rows.upper, strict=True)
    return min(((d, f"joint {names[k]}") for d, k, moves in movable if moves), default=(np.inf, ""))


def _to_bodies(space: PathSpace, q: Array) -> tuple[float, str]:
    """Return the least distance between bodies minus the clearance, m, and the bodies; infinity without shapes."""
    numeric = space.projector.numeric.at(q)
    closest = [c.closest(numeric) for c in space.problem.constraints if isinstance(c, Clearance)]
    name, distance = min(closest, key=lambda pair: pair[1], default=("", np.inf))
    return distance, name


def _to_edges(problem: ConstrainedProblem, q: Array, limits: ActuatorLimits) -> Callable[[Moment], tuple[float, str]]:
    """Return the function that computes the least distance of the center of pressure from the edges of the feet, m.

    The center of pressure is where the contact forces have no horizontal moment.  The distance is infinite if the
    feet do not span an area on level ground.
    """
    numeric, robot = Numeric(problem.robot.model).at(q), problem.robot
    points = [point_on(robot, foot.frame, corner) for foot in problem.objective.supports for corner in foot.corners]
    corners = np.array([numeric.placement(point).translation for point in points]).reshape(-1, 3)
    edges = polygon_edges(corners[:, :2]) if len(corners) and np.ptp(corners[:, 2]) < _LEVEL else None

    def distance(moment: Moment) -> tuple[float, str]:
        if edges is None:
            return np.inf, ""
        base = pin.XYZQUATToSE3(moment[0][:7])
        # The wrench of the feet on the base, about the point of the ground below the origin of the world.
        ground = pin.SE3(np.eye(3), -corners[:, 2].mean() * np.array([0.0, 0.0, 1.0]))
        wrench = (ground * base).act(pin.Force(limits.load(*moment)[:6]))
        center = np.array([-wrench.angular[1], wrench.angular[0]]) / wrench.linear[2]
        normals, offsets = edges
        return float((offsets - normals @ center).min()), "the edge of the feet"

    return distance
