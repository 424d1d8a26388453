"""The strike of a path: its velocity at the impact, and the run-up to this velocity."""

from __future__ import annotations

from dataclasses import dataclass

import daqp
import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.follow_through import FollowThrough
from impact_posture.path.path_space import PathSpace
from impact_posture.path.strike_spaces import StrikeSpaces
from impact_posture.path.stroke import shortest_stroke
from impact_posture.path.timed_curve import TimedCurve, sampled
from impact_posture.posture.program.certificate import linearized_limits
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.system.arrays import Array, null_space

# Weight of the squared velocities, relative to their limits, which are added to the largest relative velocity.
_UNIQUE = 1e-4
# An inequality or joint limit is active within this distance (m, rad, or the unit of the constraint).
_ACTIVE = 1e-3
# A contact velocity that the joints miss by more than this share cannot be reached.
_MISSED = 1e-9
# Number of bisections for the greatest speed.
_STEPS = 7


@dataclass(frozen=True, eq=False)
class Strike(JsonBlock):
    """The impact at the end of a path.

    Attributes:
        speed: Speed at which the contact point arrives at the surface, m/s.
        stated_speed: Stated speed, m/s.
        run_up_s: Time at which the run-up begins, from rest, s.
        run_up_m: Length of the run-up along the normal, m.
        contact_s: Time of the contact, s.
        velocity: Generalized velocity at the contact, shape (nv,).
        share: Largest share of a velocity limit at the contact.
        hindrance: What prevents the stated speed; empty if it is reached.
        follow_through: The stop after the impact.
    """

    speed: float
    stated_speed: float
    run_up_s: float
    run_up_m: float
    contact_s: float
    velocity: Array
    share: float
    hindrance: str = ""
    follow_through: FollowThrough | None = None


def check_strike(problem: ConstrainedProblem, speed: float) -> None:
    """Raise ``InputError`` unless a single contact with a held position can arrive at a speed above zero, m/s."""
    fault, hint = "", "leave out `strike`"
    if len(problem.objective.contacts) != 1:
        fault = "several contacts cannot strike together"
    elif (pose := problem.requirements.contact_pose) in ("free", "box"):
        fault, hint = f"needs a held contact, but `contact_pose` is {pose}", "hold it: full, position or aligned"
    elif not speed > 0:
        fault, hint = "needs an approach speed above zero", "give `speed`"
    if fault:
        raise InputError(fault, where="strike", hint=hint)


def _leaving(space: PathSpace, q: Array) -> Array:
    """Return rows ``g``, shape (m, nv), with ``gᵀν ≥ 0`` if a motion with ``ν`` comes from allowed postures to ``q``.

    A row is the gradient of an inequality or a joint that is at its bound.
    """
    model, problem = space.projector.numeric.at(q), space.problem
    limits = linearized_limits(problem, q)
    bounded = [(limits.value, limits.posture, limits.lower, limits.upper)]
    bounded += [(*c.evaluate(model), c.lower, c.upper) for c in problem.constraints if not c.equality]
    return np.vstack([
        rows
        for value, jacobian, lower, upper in bounded
        for rows in (jacobian[value > upper - _ACTIVE], -jacobian[value < lower + _ACTIVE])
    ])  # fmt: skip


def impact_velocity(spaces: StrikeSpaces, q: Array, speed: float) -> tuple[Array, float] | None:
    """Return ``ν`` with ``Jν = −v n`` on the constraints of the run-up, and its largest share of a velocity limit.

    The motion comes from postures within all inequalities and joint limits.  The velocity minimizes
    ``max |ν_i|/ν̄_i``, plus a small weight times ``Σ (ν_i/ν̄_i)²`` that makes it unique.
    Entries without a limit count only in the sum, in rad/s or m/s.  Return ``None`` if no velocity exists.
    """
    robot = spaces.run_up.problem.robot
    limited = np.isfinite(robot.velocity_limits)
    scale = np.where(limited, robot.velocity_limits, 1.0)
    A = spaces.rows(spaces.run_up)(Numeric(robot.model).at(q)) * scale
    b = np.append(np.zeros(len(A) - 1), -speed)
    least = np.linalg.pinv(A, rcond=1e-9) @ b
    if np.abs(A @ least - b).max() > _MISSED * speed:
        return None
    N = null_space(A, 1e-9)
    # The unknowns are z and s: ν/ν̄ = least + N z, and its entries with a limit are at most s in size.
    of, one, count = N[limited], np.ones((int(limited.sum()), 1)), N.shape[1]
    leaving = _leaving(spaces.run_up, q) * scale
    upper = np.concatenate([-least[limited], least[limited], leaving @ least])
    x, _, flag, _ = daqp.solve(
        _UNIQUE * np.eye(count + 1),
        np.append(np.zeros(count), 1.0),
        np.vstack([np.block([[of, -one], [-of, -one]]), np.column_stack([-leaving @ N, np.zeros(len(leaving))])]),
        upper,
        np.full_like(upper, -1e30),
        np.zeros(len(upper), dtype=np.int32),
    )
    if flag != 1:
        return None
    relative = least + N @ x[:-1]
    return relative * scale, float(np.abs(relative[limited]).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class RunUp:
    """A timed run-up to an impact.

    Attributes:
        motion: Motion from rest to the impact.
        strike: The impact; its times count from the beginning of the run-up.
        spaces: The constraints before and after the impact.
    """

    motion: TimedCurve
    strike: Strike
    spaces: StrikeSpaces


def run_up(problem: ConstrainedProblem, q: Array, speed: float, limits: ActuatorLimits) -> RunUp | str:
    """Return the shortest run-up to the stated speed at ``q``, or to the greatest speed; or why none exists.

    The contact frame turns only if there are too few joints to prevent it.
    """
    for turns in (False, True):
        spaces = StrikeSpaces(problem, q, turns=turns)
        impact = impact_velocity(spaces, q, speed)
        if impact is not None:
            break
    else:
        return "the joints cannot move the contact along the normal"
    space, (velocity, share) = spaces.run_up, impact
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
        speed=reached, stated_speed=speed, run_up_s=0.0, run_up_m=reached * end / 2, contact_s=end,
        velocity=motion.rows.v[-1], share=low * share, hindrance=hindrance,
    )  # fmt: skip
    return RunUp(motion, strike, spaces)
