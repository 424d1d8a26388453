"""A path from the start to the optimum that satisfies all constraints, timed within the robot's limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np

from impact_posture.errors import InputError
from impact_posture.impact.objective import Objective
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.path_curve import fitted_curve
from impact_posture.path.path_search import EFFORT, Connection, connect, shortened
from impact_posture.path.path_space import PathSpace
from impact_posture.path.path_timing import LimitUse, limit_use, timed
from impact_posture.path.reachable_curve import ReachableCurve
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.system.arrays import Array

# Optima that are tried, best first.
_OPTIMA = 5
# A path shorter than this (tangent length) is no motion, and a smaller relative gain is none.
_NO_MOTION, _NO_GAIN = 1e-6, 1e-6
# Visited postures that are evaluated where no optimum is reached.
_MOST_VISITED = 400


@dataclass(frozen=True, eq=False)
class PosturePath:
    """A motion from the start to the optimum, or to the best posture that is reached.

    Attributes:
        found: Whether the path ends at the optimum.
        reason: Why it does not, or what the timing leaves out; empty if there is nothing to say.
        method: How the path was found: ``continuation`` or ``sampling``; empty without a motion.
        timing: ``time-optimal``, ``scaled`` or ``slowed``; empty without a motion.
        objective: Objective at the end of the path.
        t: Times, s, shape (n,); a single zero if the start is the end.
        q: Postures on the constraints, shape (n, nq).
        v: Velocities ``ν``, shape (n, nv).
        a: Accelerations ``ν̇``, shape (n, nv).
        length: Tangent length of the path, rad mixed with m.
        max_violation: Largest violation of a constraint or joint limit at the postures.
        use: Shares of the limits over time; ``None`` without a motion.
        objectives: Objective at the times of ``use``, shape (m,).
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

    @property
    def duration(self) -> float:
        """Duration, s."""
        return float(self.t[-1])

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
            "max_violation": self.max_violation,
            "objective": self.objective,
            "q": self.q[-1].tolist(),
            "limits": self.use.largest if self.use else {},
        }


def check_package() -> None:
    """Check that the package of the extra ``path`` is installed, before anything takes time.

    Raises:
        InputError: It is not.
    """
    if find_spec("toppra") is None:
        raise InputError(
            "toppra, which times a motion, is not installed",
            where="the extra 'path'",
            hint="pip install 'impact-posture[path]'",
        )


def posture_path(solution: PostureSolution, *, seed: int = 0, effort: int = EFFORT) -> PosturePath:
    """Find a path from ``solution.initial`` to ``solution.q`` along which all constraints hold, and time it.

    If the optimum is not reached, the next certified optima are tried, best first, then the best posture on the way.

    Args:
        solution: A solved posture problem.
        seed: Seed of the samples.
        effort: Postures that the search may pull onto the constraints for each optimum.

    Raises:
        InputError: The package of the extra ``path`` is not installed.
    """
    check_package()
    space, start, objective = PathSpace(solution.problem), solution.initial, solution.problem.objective
    violated = [name for name, size, tolerance in space.violations(start) if size > tolerance]
    if violated:
        return _still(space, objective, start, f"the start violates: {', '.join(violated)}")
    found, failure = _reached(solution, space, seed, effort)
    postures = found.path or [start]
    if len(postures) == 1:
        return _still(space, objective, start, failure)
    curve = fitted_curve(space, shortened(space, postures, seed)) or fitted_curve(space, postures)
    if curve is None:
        return _still(space, objective, start, "no smooth curve through the path satisfies the constraints")
    limits = ActuatorLimits(objective, start, solution.problem.requirements)
    motion = timed(space, curve, limits)
    q = np.array([space.projector.project(curve.at(z)).q for z in motion.z])
    use = limit_use(space, motion, q, limits)
    at = np.searchsorted(motion.t, use.at)
    return PosturePath(
        not failure,
        "; ".join(filter(None, [failure, *motion.notes])),
        found.method,
        motion.method,
        float(objective.value(q[-1])),
        motion.t,
        q,
        motion.v,
        motion.a,
        space.length(list(q)),
        max(map(space.worst, q)),
        use,
        np.array([objective.value(q[k]) for k in at]),
    )


def _still(space: PathSpace, objective: Objective, q: Array, reason: str) -> PosturePath:
    """Return the path of a robot that stays at its start; it is the optimum if there is no reason why not."""
    rest = np.zeros((1, space.model.nv))
    value = float(objective.value(q))
    return PosturePath(not reason, reason, "", "", value, np.zeros(1), q[None], rest, rest, 0.0, space.worst(q))


def _reached(solution: PostureSolution, space: PathSpace, seed: int, effort: int) -> tuple[Connection, str]:
    """Return the path to the optimum, or to the best posture that is reached and why it ends there."""
    start, objective = solution.initial, solution.problem.objective
    own = ReachableCurve.of(space, start)
    others = [o.q for o in solution.optima if not np.array_equal(o.q, solution.q)]
    stay = found = Connection([start], [start], "")
    end, proof, visited = "", "", [start]
    for k, q in enumerate([solution.q, *others[: _OPTIMA - 1]]):
        target = space.pulled(space.unwound(start, q))
        if target is None or (k and objective.value(target) >= objective.value(start)):
            continue
        found = own.connect(target) if own else connect(space, start, target, seed, effort)
        visited += found.reached
        proof = proof if k else found.proof
        if found.path is not None:
            if k == 0:
                return (found if space.length(found.path) > _NO_MOTION else stay), ""
            end = f"optimum that was reached, number {k + 1} of {len(solution.optima)}"
            break
    best = objective.value(found.path[-1] if found.path else start) * (1 - _NO_GAIN)
    lowest = own.lowest() if own else min(visited[:: max(1, len(visited) // _MOST_VISITED)], key=objective.value)
    if objective.value(lowest) < best:
        found = own.connect(lowest) if own else connect(space, start, lowest, seed, effort)
        end = "posture that was reached"
    words = "was found at this contact pose, which does not prove that there is none"
    return (found if found.path else stay), (
        f"no path to the optimum {f'exists at this contact pose ({proof})' if proof else words}"
        + (f"; the path ends at the best {end}" if found.path else "; nothing better than the start was reached")
    )
