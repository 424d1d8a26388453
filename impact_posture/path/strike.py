"""The strike of a path: its velocity at the impact, and the run-up or the fall to this velocity."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import daqp
import numpy as np
import pinocchio as pin

from impact_posture.config.json_block import JsonBlock
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import point_on
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.follow_through import FollowThrough
from impact_posture.path.path_space import PathSpace
from impact_posture.path.row_interpolation import RowInterpolation
from impact_posture.path.strike_spaces import StrikeSpaces
from impact_posture.path.stroke import SHORTEST, shortest_stroke
from impact_posture.path.timed_curve import SAMPLE_TIME, TimedCurve, sampled
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.formulation.landing import falls_freely
from impact_posture.posture.loads.holdable import Holdable, ReachableWrench
from impact_posture.posture.program.certificate import linearized_limits
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.arrays import Array, null_space

# Weight of the sum of squared relative velocities ν_i/ν̄_i that is added to the largest relative velocity.
_UNIQUE = 1e-4
# Weight of a run-up beyond a bound (r in :func:`impact_velocity`), relative to the largest share of a velocity limit.
_CROWDED = 100.0
# If the curve of a run-up bends across an active bound, the robot approaches this bound from inside, with this share
# of the contact speed (rad/s or m/s).
_RATE = 0.02
# An inequality or joint limit is active within this distance (m, rad, or the unit of the constraint).
_ACTIVE = 1e-3
# A contact velocity is treated as unreachable if the joints miss it by more than this fraction.
_MISSED = 1e-9
# Number of bisections for the greatest speed.
_STEPS = 7
# Ground is level if its unit normal differs from the vertical by less than this value.
_TILT = 1e-9
# Least number of rows of a fall.
_LEAST_ROWS = 21
# Method and timing of a path that is a fall.
FREE_FALL = "free fall"


@dataclass(frozen=True, eq=False)
class Strike(JsonBlock):
    """The impact at the end of a path.

    Attributes:
        speed: Speed at which the contact point arrives at the surface, m/s.
        stated_speed: Stated speed, m/s.
        rest_s: Time at which the robot is last at rest before the contact, s.  A controller waits there.
        run_up_s: Time at which the run-up or the fall begins, s.  The run-up is along the normal.
        run_up_m: Length of the run-up along the normal, or height of the fall, m.
        contact_s: Time of the contact, s.
        velocity: Generalized velocity at the contact, shape (nv,).
        share: Largest share of a velocity limit at the contact.
        hindrance: What prevents the stated speed; empty if it is reached.
        follow_through: The stop after the impact.
    """

    speed: float
    stated_speed: float
    rest_s: float
    run_up_s: float
    run_up_m: float
    contact_s: float
    velocity: Array
    share: float
    hindrance: str = ""
    follow_through: FollowThrough | None = None


def check_strike(problem: ConstrainedProblem, speed: float) -> None:
    """Raise ``InputError`` unless contacts with held positions can arrive at a speed above zero, m/s.

    A robot that falls freely can only land on level ground, because its normals must keep their directions.
    """
    fault, hint = "", "leave out `strike`"
    wanted, gravity = problem.requirements, problem.robot.model.gravity.linear
    normals = np.array([single.oracle.at(problem.given).n for single in problem.impact.singles])
    falls = falls_freely(problem.objective, wanted.base)
    turn = any(contact.normal_frame == "contact" for contact in problem.objective.contacts)
    loose = [pose for pose in (wanted.contact_pose, *wanted.other_poses) if pose in ("free", "box")]
    if loose:
        fault, hint = f"needs a held contact, but `contact_pose` is {loose[0]}", "hold it: full, position or aligned"
    elif not speed > 0:
        fault, hint = "needs an approach speed above zero", "give `speed`"
    elif falls and (turn or np.abs(normals + gravity / np.linalg.norm(gravity)).max() > _TILT):
        fault, hint = "needs level ground, because nothing supports the robot, so it falls", "give `support`"
    if fault:
        raise InputError(fault, where="strike", hint=hint)


def _room(space: PathSpace, q: Array) -> tuple[Array, Array, Array]:
    """Return rows ``g``, shape (m, nv), and distances, shape (m,), such that a step ``δ`` needs ``gᵀδ ≤`` distance.

    A row is the gradient of an inequality or joint limit.  Also return, for each bound, whether a motion can reach
    the bound from inside, shape (m,).  This is false for a joint that does not move, and for a bound on a robot at
    rest.
    """
    model, problem = space.projector.numeric.at(q), space.problem
    limits = linearized_limits(problem, q)
    bounded = [(limits.value, limits.posture, limits.lower, limits.upper, limits.lower < limits.upper)]
    bounded += [
        (*c.evaluate(model), c.lower, c.upper, np.full(c.rows, not isinstance(c, Holdable | ReachableWrench)))
        for c in problem.constraints
        if not c.equality
    ]
    value, g, lower, upper, inside = (np.concatenate(parts) for parts in zip(*bounded, strict=True))
    distance = np.concatenate([upper - value, value - lower])
    known = np.isfinite(distance)
    # At a posture that violates a bound by a rounding error, the robot can still be at rest.
    return np.vstack([g, -g])[known], np.maximum(distance[known], 0.0), np.tile(inside, 2)[known]


def _tipping(problem: ConstrainedProblem, model: Numeric) -> Array:
    """Return rows ``B``, shape (k, nv): the capture point ``c + ċ √(z/g)`` is above the feet if ``Bν ≤ 1``.

    ``z`` is the height of the center of mass ``c`` above the feet (Pratt et al. 2006).
    """
    over = next((c for c in problem.constraints if isinstance(c, CenterOfMassOverFeet)), None)
    if over is None:
        return np.zeros((0, model.model.nv))
    beyond, jacobian = over.evaluate(model)
    # The center of mass can be at an edge of the feet if the bound has no margin and is active.
    room = np.maximum(-beyond, _ACTIVE)
    feet = [point_on(problem.robot, s.frame, s.offset) for s in problem.objective.supports]
    height = model.center_of_mass()[0][2] - np.mean([model.placement(foot).translation[2] for foot in feet])
    gravity = np.linalg.norm(problem.robot.model.gravity.linear)
    return np.asarray(jacobian / (room * np.sqrt(gravity / height))[:, None])


def impact_velocity(
    spaces: StrikeSpaces, q: Array, speed: float, time: float, *, balanced: bool = True, inside: bool = False
) -> tuple[Array, float] | None:
    """Return ``ν`` with ``Jν = −v n`` on the constraints of the run-up, and the largest ``|ν_i|/ν̄_i``.

    All contacts arrive with the same speed, each along its normal.  The velocity minimizes the largest of
    ``|ν_i|/ν̄_i`` and, if ``balanced``, of the shares of :func:`_tipping`, plus a small weight times ``Σ (ν_i/ν̄_i)²``
    that makes it unique.  Entries without a limit are included only in the sum, in rad/s or m/s.  If possible,
    ``q − νt`` is within inequalities and joint limits to first order, where ``t`` is the ``time``, s.  If this is
    impossible, the violation relative to the distance from the bound is minimized.  If ``inside``, the robot
    approaches active bounds from inside, with :data:`_RATE`.  Return ``None`` if no velocity exists.
    """
    robot = spaces.run_up.problem.robot
    limited = np.isfinite(robot.velocity_limits)
    scale = np.where(limited, robot.velocity_limits, 1.0)
    A = spaces.rows(spaces.run_up)(Numeric(robot.model).at(q)) * scale
    b = np.where(np.arange(len(A)) < len(A) - len(spaces.normals), 0.0, -speed)
    least = np.linalg.pinv(A, rcond=1e-9) @ b
    if np.abs(A @ least - b).max() > _MISSED * speed:
        return None
    N = null_space(A, 1e-9)
    # The unknowns are z, s and r, with ν/ν̄ = least + N z.  All shares are at most s, and the run-up needs at most
    # r ≥ 1 times the distance to a bound.
    single = np.eye(len(scale))[limited]
    tipping = _tipping(spaces.run_up.problem, Numeric(robot.model).at(q)) * scale
    shares = np.vstack([single, -single, *([tipping] if balanced else [])])
    toward, distance, movable = _room(spaces.run_up, q)
    rows = np.vstack([shares, -toward * scale, np.zeros(len(scale))])
    of_share = np.repeat([1.0, 0.0], [len(shares), len(rows) - len(shares)])
    of_room = np.concatenate([np.zeros(len(shares)), distance / time, [1.0]])
    rate = _RATE * speed * np.where(inside & (distance < _ACTIVE), movable, 0.0)
    upper = -rows @ least - np.concatenate([np.zeros(len(shares)), rate, [1.0]])
    x, _, flag, _ = daqp.solve(
        _UNIQUE * np.eye(N.shape[1] + 2),
        np.append(np.zeros(N.shape[1]), [1.0, _CROWDED]),
        np.column_stack([rows @ N, -of_share, -of_room]),
        upper,
        np.full_like(upper, -1e30),
        np.zeros(len(upper), dtype=np.int32),
    )
    if flag != 1:
        return None
    relative = least + N @ x[:-2]
    return relative * scale, float(np.abs(relative[limited]).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class RunUp:
    """A timed run-up to an impact.

    Attributes:
        motion: Motion from rest to the impact.
        strike: The impact; its times count from the beginning of the motion.
        spaces: The constraints before and after the impact.
    """

    motion: TimedCurve
    strike: Strike
    spaces: StrikeSpaces


def run_up(problem: ConstrainedProblem, q: Array, speed: float, limits: ActuatorLimits) -> RunUp | str:
    """Return the shortest run-up to the stated or else the greatest speed at ``q``, or why no run-up exists.

    The contact frames turn only if there are too few joints to prevent a turn.  The capture point of a robot that
    stands stays away from the edges of the feet, unless this condition limits the speed.  If active bounds limit the
    speed, the robot approaches these bounds from inside.  A robot without support falls (:func:`_fall`).
    """
    if falls_freely(problem.objective, problem.requirements.base):
        return _fall(problem, q, speed)
    spaces, time = StrikeSpaces(problem, q), SHORTEST[limits.rotors] / 2
    fastest: RunUp | str = "the joints cannot move the contact along the normal"
    if impact_velocity(spaces, q, speed, time) is None:
        spaces = StrikeSpaces(problem, q, turns=True)
    for balanced, inside in product((True, False) if problem.requirements.com_over_feet else (False,), (False, True)):
        impact = impact_velocity(spaces, q, speed, time, balanced=balanced, inside=inside)
        run = fastest if impact is None else _timed_run_up(spaces, q, *impact, speed, limits)
        if isinstance(run, RunUp) and not run.strike.hindrance:
            return run
        if isinstance(fastest, str) or (isinstance(run, RunUp) and run.strike.speed > fastest.strike.speed):
            fastest = run
    return fastest


def _fall(problem: ConstrainedProblem, q: Array, speed: float) -> RunUp | str:
    """Return the free fall from rest onto level ground in the posture ``q``, or what prevents the fall.

    The joints are at rest, so ``J_i ν = −v n_i`` needs no share of a velocity limit.
    """
    spaces, (model, nv) = StrikeSpaces(problem, q), (problem.robot.model, problem.robot.nv)
    gravity = np.array(model.gravity.linear)
    end = speed / float(np.linalg.norm(gravity))
    t = np.linspace(0.0, end, max(_LEAST_ROWS, int(np.ceil(end / SAMPLE_TIME)) + 1))
    a = np.zeros(nv)
    a[:3] = pin.XYZQUATToSE3(q[:7]).rotation.T @ gravity
    postures = np.array([pin.integrate(model, q, -a * (end**2 - x**2) / 2) for x in t])
    checked = [each for row in postures for each in spaces.approach.violations(row)]
    if blocked := dict.fromkeys(name for name, size, tolerance in checked if size > tolerance):
        return f"the fall violates: {', '.join(blocked)}"
    rows, height = RowInterpolation(model, t, postures, np.outer(t, a), np.tile(a, (len(t), 1))), speed * end / 2
    strike = Strike(
        speed=speed,
        stated_speed=speed,
        rest_s=0.0,
        run_up_s=0.0,
        run_up_m=height,
        contact_s=end,
        velocity=rows.v[-1],
        share=0.0,
    )
    return RunUp(TimedCurve(rows, FREE_FALL), strike, spaces)


def _timed_run_up(
    spaces: StrikeSpaces, q: Array, velocity: Array, share: float, speed: float, limits: ActuatorLimits
) -> RunUp | str:
    """Return the shortest run-up to the velocity of :func:`impact_velocity`, or to the greatest share of it."""
    space, problem = spaces.run_up, spaces.run_up.problem
    low, high, hindrance = 0.0, 1.0, ""
    if share > 1:
        worst = int(np.argmax(np.abs(velocity) / problem.robot.velocity_limits))
        high, hindrance = 1 / share, f"the velocity of {problem.robot.tangent_names[worst]}"
    rows = spaces.rows(space)
    stroke, duration = shortest_stroke(space, q, velocity, rows, limits, before=True, factor=high)
    if stroke.curve is None:
        return f"no run-up is possible, because of {stroke.end}"
    if duration is not None:
        low = high
    for _ in range(_STEPS if duration is None else 0):
        middle = (low + high) / 2
        shorter = stroke.shortest(limits, middle)
        low, high, duration = (low, middle, duration) if shorter is None else (middle, high, shorter)
    if low < 1 and not (share > 1 and low == high):
        hindrance = stroke.hindrance(limits, high)
    if duration is None:
        return f"no speed is possible, because of {hindrance}"
    notes = (f"{limits.missing}: the run-up is timed by velocities alone",) if limits.missing else ()
    motion = sampled(space, stroke.curve, limits, stroke.law(duration, low), "scaled", notes)
    reached, end = low * speed, float(motion.rows.t[-1])
    strike = Strike(
        speed=reached, stated_speed=speed, rest_s=0.0, run_up_s=0.0, run_up_m=reached * end / 2, contact_s=end,
        velocity=motion.rows.v[-1], share=low * share, hindrance=hindrance,
    )  # fmt: skip
    return RunUp(motion, strike, spaces)
