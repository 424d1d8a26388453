"""Find a path from the start to the optimum on the constraints, and time it within the limits of the robot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from importlib.util import find_spec

import numpy as np

from impact_posture.errors import InputError
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.blend import blended_curve
from impact_posture.path.follow_through import follow_through
from impact_posture.path.path_curve import fitted_curve
from impact_posture.path.path_search import EFFORT, Connection, connect, shortened
from impact_posture.path.path_space import PathSpace
from impact_posture.path.path_timing import LimitUse, limit_use, time_optimal, timed, topp_ra_times
from impact_posture.path.reachable_curve import ReachableCurve
from impact_posture.path.row_interpolation import INTERPOLATION, RowInterpolation
from impact_posture.path.strike import FREE_FALL, RunUp, Strike, check_strike, run_up
from impact_posture.path.strike_spaces import landed
from impact_posture.path.timed_curve import TimedCurve
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.approach.attainable_speed import USABLE
from impact_posture.posture.formulation.landing import falls_freely
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.system.arrays import Array

# Reason why a path to the optimum is not returned.
_NOT_SMOOTH = "no smooth curve through the path satisfies the constraints"
# What prevents a higher speed, if the program required the greatest speed.
_EVERYWHERE = f"{USABLE:.0%} of the velocity limits, joint limits or other constraints in every posture of the search"
# Largest number of optima to try, best first.
_OPTIMA = 5
# The path strikes at the best optimum that allows at least the greatest speed divided by this factor.
_FASTER = 1.02
# A path with a tangent length below this value, rad mixed with m, is treated as no motion.
_NO_MOTION = 1e-6
# A relative reduction of the objective below this value is treated as no reduction.
_NO_GAIN = 1e-6
# Number of postures of a run-up from which a blended curve is computed.
_POSTURES = 65
# Largest number of reached postures to evaluate if no optimum is reached.
_MOST_VISITED = 400


@dataclass(frozen=True, eq=False)
class PosturePath(RowInterpolation):
    """A motion from the start to the optimum, or to the best reached posture; a robot that does not move has one row.

    Attributes:
        found: Whether the path ends at the optimum.
        reason: Why the path does not end at the optimum, and which limits the timing ignores; empty if neither
            applies.
        method: Method of the search: ``continuation`` or ``sampling``; ``free fall`` without a search; empty without
            a motion.
        timing: ``time-optimal``, ``scaled``, ``slowed`` or ``free fall``; empty without a motion.
        objective: Objective at the end of the path.
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
    def played(self) -> RowInterpolation:
        """The path and, after a strike, the follow-through.  The velocity at the contact is before the impact."""
        after = self.strike and self.strike.follow_through and self.strike.follow_through.rows
        return self.followed_by(after) if after else self

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
    jobs: int = 1,
) -> PosturePath:
    """Find a path from ``solution.initial`` to ``solution.q`` along which all constraints hold, and time it.

    If the search does not reach the optimum, it tries other certified optima, best first.  If no optimum is reached,
    the path ends at the best reached posture.  For each optimum, the search pulls at most ``effort`` postures onto
    the constraints.

    If ``strike`` is given, the contact point arrives at the optimum with this speed, m/s
    (:mod:`~impact_posture.path.strike`).  If no optimum allows a strike at this speed, the path ends at the optimum
    with the greatest speed.  If no optimum allows a strike at any speed, the path ends at rest.  ``restitution`` is
    the coefficient of the predicted impact, after which :mod:`~impact_posture.path.follow_through` stops the robot.
    If nothing supports the robot, its path is a fall to the optimum.  ``jobs`` processes time the path
    and compute the stops.

    Raises:
        InputError: The package of the extra ``path`` is not installed, or the contact cannot strike.
    """
    check_package()
    problem, start, no_strike = solution.problem, solution.initial, ""
    space, limits = PathSpace(problem), ActuatorLimits(problem.objective, start, problem.requirements)
    if strike is not None:
        check_strike(problem, strike)
        if falls_freely(problem.objective, problem.requirements.base):
            limits = ActuatorLimits(landed(problem, start).objective, start, problem.requirements)
        struck = _struck(solution, space, limits, strike, restitution, seed, effort, jobs)
        if isinstance(struck, PosturePath):
            return struck
        no_strike = f"the path ends at rest, because {struck}"
    if fault := _fault(space, start):
        return _still(space, start, fault, no_strike)
    connection, failure = _reached(solution, space, seed, effort)
    postures = connection.path or [start]
    if len(postures) == 1:
        return _still(space, start, failure, no_strike)
    motion = _timed(space, postures, limits, seed, jobs)
    if motion is None:
        return _still(space, start, _NOT_SMOOTH, no_strike)
    return _finished(space, motion, connection.method, limits, failure, no_strike)


def fall_path(problem: ConstrainedProblem, q: Array, speed: float) -> PosturePath:
    """Return the free fall onto the contacts in the posture ``q``, shape (nq,), at a speed, m/s, without a stop.

    Raises:
        InputError: The robot does not fall, or something is in the way.
    """
    check_strike(problem, speed)
    if not falls_freely(problem.objective, problem.requirements.base):
        raise InputError(
            "does not fall", where=problem.robot.name, hint="use a floating base without rotors and feet"
        )
    limits = ActuatorLimits(landed(problem, q).objective, q, problem.requirements)
    run = run_up(problem, q, speed, limits)
    if isinstance(run, str):
        raise InputError(run, where="strike", hint="change the posture")
    return _finished(run.spaces.approach, run.motion, FREE_FALL, limits, "", strike=run.strike)


def _fault(space: PathSpace, start: Array) -> str:
    violated = [name for name, size, tolerance in space.violations(start) if size > tolerance]
    return f"the start violates: {', '.join(violated)}" if violated else ""


def _timed(
    space: PathSpace, postures: list[Array], limits: ActuatorLimits, seed: int, jobs: int
) -> TimedCurve | None:
    """Return the timed motion along a path from rest to rest; ``None`` if no smooth curve is on the constraints."""
    curve = fitted_curve(space, shortened(space, postures, seed)) or fitted_curve(space, postures)
    return None if curve is None else timed(space, curve, limits, jobs)


def _finished(
    space: PathSpace,
    motion: TimedCurve,
    method: str,
    limits: ActuatorLimits,
    failure: str,
    note: str = "",
    strike: Strike | None = None,
) -> PosturePath:
    """Return the path with the shares of the limits and the objective along it."""
    rows, use, objective = motion.rows, limit_use(space, motion, limits), space.problem.objective
    objectives = np.array([objective.value(rows.at(t)[0]) for t in use.at])
    reason = "; ".join(filter(None, [failure, note, *motion.notes]))
    return PosturePath(
        **vars(rows), found=not failure, reason=reason, method=method, timing=motion.method,
        objective=float(objective.value(rows.q[-1])), length=space.length(rows.q),
        max_violation=max(map(space.worst, rows.q)), use=use, objectives=objectives, strike=strike,
    )  # fmt: skip


def _struck(
    solution: PostureSolution,
    space: PathSpace,
    limits: ActuatorLimits,
    speed: float,
    restitution: float,
    seed: int,
    effort: int,
    jobs: int,
) -> PosturePath | str:
    """Return a path that strikes at an optimum with the stated or the greatest speed, or why no path strikes."""
    # The program requires the greatest possible speed if no posture allows the stated speed.
    constraints = solution.problem.constraints if solution.problem.requirements.strike else ()
    required = min([speed, *(c.speed for c in constraints if isinstance(c, ApproachSpeed))])
    failure, slower, best = "", list[tuple[int, RunUp]](), None
    for k, target in _targets(solution, space):
        run = run_up(solution.problem, target, required, limits)
        if isinstance(run, str):
            failure = failure or run
        elif run.strike.hindrance:
            struck = run.strike
            slow = f"the optimum allows a strike at {struck.speed:.3g} m/s at most, because of {struck.hindrance}"
            failure = failure or slow
            slower.append((k, run))
        else:
            led = _led(solution.initial, run, limits, seed, effort, jobs)
            if not isinstance(led, str):
                best = k, *led
                break
            failure = failure or led
    # The path to a run-up takes longer to compute than the run-up, so it is computed for slower strikes only now.
    while slower and best is None:
        enough = max(run.strike.speed for _, run in slower) / _FASTER
        k, run = slower.pop(next(i for i, (_, run) in enumerate(slower) if run.strike.speed >= enough))
        led = _led(solution.initial, run, limits, seed, effort, jobs)
        if not isinstance(led, str):
            best = k, *led
        elif k == 0:
            failure = led
    if best is None:
        return failure or "no optimum allows a strike"
    k, run, method = best
    after = follow_through(solution.problem, run.motion.rows.q[-1], run.strike.velocity, restitution, limits, jobs)
    failure = f"{failure}; the path ends at optimum number {k + 1} of {len(solution.optima)}" if k else ""
    hindrance = run.strike.hindrance or (_EVERYWHERE if required < speed else "")
    strike = replace(run.strike, stated_speed=speed, hindrance=hindrance, follow_through=after)
    return _finished(run.spaces.approach, run.motion, method, limits, failure, strike=strike)


def _led(
    start: Array, run: RunUp, limits: ActuatorLimits, seed: int, effort: int, jobs: int
) -> tuple[RunUp, str] | str:
    """Return a run-up preceded by a motion from the start, and the search method; or why no such motion exists."""
    space, motion = run.spaces.approach, run.motion
    if motion.method == FREE_FALL:
        return run, FREE_FALL
    here = run.spaces.begin(start)
    if here is None:
        return _fault(space, start)
    connection = connect(space, here, motion.rows.q[0], seed, effort)
    if connection.path is None:
        return "no path leads to the beginning of the run-up"
    moved, notes = space.distance(start, here), motion.notes
    if moved > _NO_MOTION:
        at = "so that the contact is above the surface"
        notes = (f"the path begins {moved:.2g} (rad, m) from the start, {at}", *notes)
    if space.length(connection.path) <= _NO_MOTION:
        return replace(run, motion=replace(motion, notes=notes)), connection.method
    if (whole := _in_one_piece(run, shortened(space, connection.path, seed), limits, notes)) is not None:
        return whole, connection.method
    there = _timed(space, connection.path, limits, seed, jobs)
    if there is None:
        return _NOT_SMOOTH
    motion = TimedCurve(there.rows.followed_by(motion.rows), there.method, (*there.notes, *notes))
    rest, end = float(there.rows.t[-1]), float(motion.rows.t[-1])
    strike = replace(run.strike, rest_s=rest, run_up_s=rest, contact_s=end)
    return replace(run, motion=motion, strike=strike), connection.method


def _in_one_piece(run: RunUp, way: list[Array], limits: ActuatorLimits, notes: tuple[str, ...]) -> RunUp | None:
    """Return the run-up after a way without a rest between them; ``None`` if no time-optimal motion is possible."""
    space, (law, rows), strike = run.spaces.approach, (run.motion.law, run.motion.rows), run.strike
    if law is None or not topp_ra_times(space, limits):
        return None
    evenly = np.linspace(law.at(np.zeros(1))[0][0], 1.0, _POSTURES)
    postures = [rows.q[0], *(rows.at(law.when(s))[0] for s in evenly[1:-1]), rows.q[-1]]
    step = strike.velocity * (strike.run_up_m / strike.speed / (_POSTURES - 1))
    if (blended := blended_curve(space, way, postures, step)) is None:
        return None
    curve, place = blended
    rate = float(np.linalg.norm(strike.velocity) / np.linalg.norm(curve.moment(1.0)[1]))
    motion = time_optimal(space, curve, limits, place, rate)
    if motion is None or motion.law is None:
        return None
    begin, end, length = motion.law.when(place), float(motion.rows.t[-1]), strike.speed * (1 - place) / rate
    strike = replace(strike, run_up_s=begin, run_up_m=length, contact_s=end, velocity=motion.rows.v[-1])
    return replace(run, motion=replace(motion, notes=notes), strike=strike)


def _still(space: PathSpace, q: Array, *reasons: str) -> PosturePath:
    """Return the path of a robot that does not move; the path ends at the optimum if the first reason is empty."""
    rest, value = np.zeros((1, space.model.nv)), float(space.problem.objective.value(q))
    return PosturePath(
        space.model, np.zeros(1), q[None], rest, rest, found=not reasons[0],
        reason="; ".join(filter(None, reasons)), method="", timing="",
        objective=value, length=0.0, max_violation=space.worst(q),
    )  # fmt: skip


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
    unproved = "is known at this contact pose, which does not prove that none exists"
    reason = f"no path to the optimum {f'exists at this contact pose ({proof})' if proof else unproved}; "
    if connection.path:
        return connection, f"{reason}the path ends at the best {end}"
    return stay, f"{reason}no posture better than the start was reached"
