"""Find a path from the start to the optimum on the constraints, and time it within the limits of the robot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from importlib.util import find_spec

import numpy as np

from impact_posture.errors import InputError
from impact_posture.impact.objective import Objective
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.follow_through import follow_through
from impact_posture.path.path_curve import fitted_curve
from impact_posture.path.path_search import EFFORT, Connection, connect, shortened
from impact_posture.path.path_space import PathSpace
from impact_posture.path.path_timing import LimitUse, limit_use, timed
from impact_posture.path.reachable_curve import ReachableCurve
from impact_posture.path.row_interpolation import INTERPOLATION
from impact_posture.path.strike import RunUp, Strike, check_strike, run_up
from impact_posture.path.timed_curve import TimedCurve
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.system.arrays import Array

# Why a path that was reached is not returned.
_NOT_SMOOTH = "no smooth curve through the path satisfies the constraints"
# Largest number of optima to try, best first.
_OPTIMA = 5
# A path below this tangent length counts as no motion.  A relative gain below the second value counts as no gain.
_NO_MOTION, _NO_GAIN = 1e-6, 1e-6
# Largest number of reached postures to evaluate if no optimum is reached.
_MOST_VISITED = 400


@dataclass(frozen=True, eq=False)
class PosturePath:
    """A motion from the start to the optimum, or to the best reached posture.

    Attributes:
        found: Whether the path ends at the optimum.
        reason: Why the path does not end at the optimum, and which limits the timing ignores; empty if neither
            applies.
        method: Method of the search: ``continuation`` or ``sampling``; empty without a motion.
        timing: ``time-optimal``, ``scaled`` or ``slowed``; empty without a motion.
        objective: Objective at the end of the path.
        t: Times, s, shape (n,); a single zero without a motion.  Between two times, the motion is a
            :class:`~impact_posture.path.row_interpolation.RowInterpolation`.
        q: Postures, shape (n, nq).
        v: Generalized velocities ``ν``, shape (n, nv).
        a: Generalized accelerations ``ν̇``, shape (n, nv).
        length: Tangent length of the path, rad mixed with m.
        max_violation: Largest violation of a constraint or joint limit at the postures.
        use: Shares of the limits over time; ``None`` without a motion.
        objectives: Objective at the times ``use.at``, shape (m,).
        strike: The impact at the end of the path; ``None`` if the path ends at rest.
    """

    found: bool
    reason: str
    method: str
    timing: str
    objective: float
    t: Array
    q: Array
    v: Array
    a: Array
    length: float
    max_violation: float
    use: LimitUse | None = None
    objectives: Array = field(default_factory=lambda: np.zeros(0))
    strike: Strike | None = None

    @property
    def duration(self) -> float:
        """Duration, s."""
        return float(self.t[-1])

    @property
    def played(self) -> tuple[Array, Array, Array]:
        """Times ``t``, postures ``q`` and velocities ``v`` of the path and, after a strike, of the follow-through.

        At the contact, the velocity is that before the impact.
        """
        after = self.strike and self.strike.follow_through and self.strike.follow_through.rows
        if not after:
            return self.t, self.q, self.v
        t = np.append(self.t, self.t[-1] + after.t[1:])
        return t, np.vstack([self.q, after.q[1:]]), np.vstack([self.v, after.v[1:]])

    def to_dict(self) -> dict[str, object]:
        """Return JSON content."""
        return {
            "found": self.found,
            "reason": self.reason,
            "method": self.method,
            "timing": self.timing,
            "duration_s": self.duration,
            "length": self.length,
            "points": len(self.t),
            "interpolation": INTERPOLATION,
            "max_violation": self.max_violation,
            "objective": self.objective,
            "q": self.q[-1].tolist(),
            "limits": self.use.largest if self.use else {},
            **({} if self.strike is None else {"strike": self.strike.to_dict()}),
        }


def check_package() -> None:
    """Raise ``InputError`` early if the package of the extra ``path`` is not installed."""
    if find_spec("toppra") is None:
        fault = "toppra, which times a motion, is not installed"
        raise InputError(fault, where="the extra 'path'", hint="pip install 'impact-posture[path]'")


def posture_path(
    solution: PostureSolution,
    *,
    seed: int = 0,
    effort: int = EFFORT,
    strike: float | None = None,
    restitution: float = 0.0,
) -> PosturePath:
    """Find a path from ``solution.initial`` to ``solution.q`` along which all constraints hold, and time it.

    If the search does not reach the optimum, it tries other certified optima, best first.  If no optimum is reached,
    the path ends at the best reached posture.  For each optimum, the search pulls at most ``effort`` postures onto
    the constraints.

    If ``strike`` is given, the contact point arrives at the optimum with this speed, m/s
    (:mod:`~impact_posture.path.strike`).  If no optimum can be struck at this speed, the path strikes the optimum
    with the greatest speed.  If no optimum can be struck at all, the path ends at rest.  ``restitution`` is the
    coefficient of the predicted impact, after which :mod:`~impact_posture.path.follow_through` stops the robot.

    Raises:
        InputError: The package of the extra ``path`` is not installed, or the contact cannot strike.
    """
    check_package()
    space, start, objective = PathSpace(solution.problem), solution.initial, solution.problem.objective
    limits, no_strike = ActuatorLimits(objective, start, solution.problem.requirements), ""
    if strike is not None:
        check_strike(solution.problem, strike)
        struck = _struck(solution, space, limits, strike, restitution, seed, effort)
        if isinstance(struck, PosturePath):
            return struck
        no_strike = f"the path ends at rest, because {struck}"
    if fault := _fault(space, start):
        return _still(space, objective, start, fault, no_strike)
    connection, failure = _reached(solution, space, seed, effort)
    postures = connection.path or [start]
    if len(postures) == 1:
        return _still(space, objective, start, failure, no_strike)
    motion = _timed(space, postures, limits, seed)
    if motion is None:
        return _still(space, objective, start, _NOT_SMOOTH, no_strike)
    return _finished(space, motion, connection.method, limits, failure, no_strike)


def _fault(space: PathSpace, start: Array) -> str:
    violated = [name for name, size, tolerance in space.violations(start) if size > tolerance]
    return f"the start violates: {', '.join(violated)}" if violated else ""


def _timed(space: PathSpace, postures: list[Array], limits: ActuatorLimits, seed: int) -> TimedCurve | None:
    """Return the timed motion along a path from rest to rest; ``None`` if no smooth curve is on the constraints."""
    curve = fitted_curve(space, shortened(space, postures, seed)) or fitted_curve(space, postures)
    return None if curve is None else timed(space, curve, limits)


def _finished(
    space: PathSpace,
    motion: TimedCurve,
    method: str,
    limits: ActuatorLimits,
    failure: str,
    *notes: str,
    strike: Strike | None = None,
) -> PosturePath:
    """Return the path with the shares of the limits and the objective along it."""
    rows, use, objective = motion.rows, limit_use(space, motion, limits), space.problem.objective
    objectives = np.array([objective.value(rows.at(t)[0]) for t in use.at])
    reason = "; ".join(filter(None, [failure, *notes, *motion.notes]))
    end, length, violation = float(objective.value(rows.q[-1])), space.length(rows.q), max(map(space.worst, rows.q))
    return PosturePath(
        not failure, reason, method, motion.method, end,
        rows.t, rows.q, rows.v, rows.a, length, violation, use, objectives, strike,
    )  # fmt: skip


def _struck(
    solution: PostureSolution,
    space: PathSpace,
    limits: ActuatorLimits,
    speed: float,
    restitution: float,
    seed: int,
    effort: int,
) -> PosturePath | str:
    """Return the path that strikes the first optimum with the stated or else the greatest speed; or why none does."""
    start, runs, first = solution.initial, list[tuple[int, RunUp]](), ""
    for k, target in _targets(solution, space):
        run = run_up(solution.problem, target, speed, limits)
        if isinstance(run, str):
            first = first or run
            continue
        runs.append((k, run))
        if not run.strike.hindrance:
            break
        most = f"at {run.strike.speed:.3g} m/s at most, because of {run.strike.hindrance}"
        first = first or f"the optimum can be struck {most}"
    blocked = ""
    for k, run in sorted(runs, key=lambda each: -each[1].strike.speed):
        before, begin = run.spaces.approach, run.motion.rows.q[0]
        # The surface at the optimum can be nearer than the contact point at the start, which then has to leave it.
        here = start if before.valid(start) else before.pulled(start)
        if here is None:
            blocked = blocked or _fault(before, start)
            continue
        connection = connect(before, here, begin, seed, effort)
        if connection.path is None:
            blocked = blocked or "no path to the begin of the run-up was found"
            continue
        motion, strike = run.motion, run.strike
        if before.length(connection.path) > _NO_MOTION:
            there = _timed(before, connection.path, limits, seed)
            if there is None:
                blocked = blocked or _NOT_SMOOTH
                continue
            shift = float(there.rows.t[-1])
            motion = TimedCurve(there.rows.followed_by(motion.rows), there.method, (*there.notes, *motion.notes))
            strike = replace(strike, run_up_s=shift, contact_s=float(motion.rows.t[-1]))
        after = follow_through(solution.problem, motion.rows.q[-1], strike.velocity, restitution, limits)
        strike = replace(strike, follow_through=after)
        failure = (
            f"{first or blocked}; the path ends at optimum number {k + 1} of {len(solution.optima)}" if k else ""
        )
        moved = before.distance(start, here)
        note = f"the path begins {moved:.2g} (rad, m) from the start, so that the contact is above the surface"
        notes = [note] if moved > _NO_MOTION else []
        return _finished(before, motion, connection.method, limits, failure, *notes, strike=strike)
    return blocked or first or "no optimum can be struck"


def _still(space: PathSpace, objective: Objective, q: Array, failure: str, *notes: str) -> PosturePath:
    """Return the path of a robot that stays at its start, which is the optimum if ``failure`` is empty."""
    rest = np.zeros((1, space.model.nv))
    value = float(objective.value(q))
    reason = "; ".join(filter(None, [failure, *notes]))
    return PosturePath(not failure, reason, "", "", value, np.zeros(1), q[None], rest, rest, 0.0, space.worst(q))


def _targets(solution: PostureSolution, space: PathSpace) -> Iterator[tuple[int, Array]]:
    """Yield the numbers of the optima to try, best first, and their postures on the constraints."""
    value, start = solution.problem.objective.value, solution.initial
    others = [o.q for o in solution.optima if not np.array_equal(o.q, solution.q)]
    for k, q in enumerate([solution.q, *others[: _OPTIMA - 1]]):
        target = space.pulled(space.unwound(start, q))
        if target is not None and (not k or value(target) < value(start)):
            yield k, target


def _reached(solution: PostureSolution, space: PathSpace, seed: int, effort: int) -> tuple[Connection, str]:
    """Return the path to the optimum, or the path to the best reached posture and the reason."""
    start, objective = solution.initial, solution.problem.objective
    curve = ReachableCurve.of(space, start)
    stay = connection = Connection([start], [start], "")
    end, proof, reached = "", "", [start]

    def connect_to(target: Array) -> Connection:
        return curve.connect(target) if curve else connect(space, start, target, seed, effort)

    for k, target in _targets(solution, space):
        connection = connect_to(target)
        reached += connection.reached
        proof = proof if k else connection.proof
        if connection.path is not None:
            if k == 0:
                return (connection if space.length(connection.path) > _NO_MOTION else stay), ""
            end = f"optimum that was reached, number {k + 1} of {len(solution.optima)}"
            break
    best = objective.value(connection.path[-1] if connection.path else start) * (1 - _NO_GAIN)
    lowest = curve.lowest() if curve else min(reached[:: max(1, len(reached) // _MOST_VISITED)], key=objective.value)
    if objective.value(lowest) < best:
        connection, end = connect_to(lowest), "posture that was reached"
    unproved = "was found at this contact pose, which does not prove that none exists"
    reason = f"no path to the optimum {f'exists at this contact pose ({proof})' if proof else unproved}; "
    if connection.path:
        return connection, f"{reason}the path ends at the best {end}"
    return stay, f"{reason}nothing better than the start was reached"
