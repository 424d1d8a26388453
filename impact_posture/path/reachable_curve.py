"""Paths of a robot with one degree of freedom left, whose self-motion is a curve.

The curve either leads to the optimum, or proves that no path exists.  No path exists if the optimum is on another
component of the self-motion, or if the constraints cut the curve in both directions.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path.path_search import Connection
from impact_posture.path.path_space import PathSpace
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.self_motion import LONGEST_STEP, SelfMotion, component_through
from impact_posture.posture.program.constrained_problem import equality_jacobian, rank
from impact_posture.system.arrays import Array


class ReachableCurve:
    """Self-motion curve through a valid start, shape (nq,).  A *side* is the part in one direction."""

    def __init__(self, space: PathSpace, start: Array, motion: SelfMotion) -> None:
        self._space, self._start, self._motion, self._manifold = space, start, motion, motion.manifold
        (curve,) = motion.components
        home = int(np.linalg.norm(curve.x - self._manifold.chart.to_x(start), axis=1).argmin())
        ahead, back = curve.x[home + 1 :], curve.x[:home][::-1]
        if curve.closed:
            ahead, back = curve.x[1:], curve.x[-2::-1]
        self._sides = [self._side(nodes) for nodes in (ahead, back)]

    @staticmethod
    def of(space: PathSpace, start: Array) -> ReachableCurve | None:
        """Return the curve through a start; ``None`` if it is not a curve, or if it ends at a singular posture."""
        problem = space.problem
        jacobian = equality_jacobian(problem, space.projector.numeric.at(start))
        if not isinstance(problem.objective, WorstCaseObjective) or problem.robot.nv - rank(jacobian) != 1:
            return None
        motion = _followed(ConstraintManifold(problem), start)
        return ReachableCurve(space, start, motion) if motion else None

    def connect(self, target: Array) -> Connection:
        """Return the path along the curve to a posture on the constraints, or the proof that no path exists."""
        reached = [q for side, _ in self._sides for q in side]
        paths = [path for side, _ in self._sides if (path := self._along(side, target))]
        if paths:
            return Connection(min(paths, key=self._space.length), reached, "continuation")
        x = self._manifold.chart.to_x(target)[None]
        proof = "the constraints cut the self-motion in both directions" if all(cut for _, cut in self._sides) else ""
        if self._motion.component_of(x)[0] < 0:
            # Follow the curve of the target, too, because steps without interval bounds can miss the target.
            other = _followed(self._manifold, target)
            home = self._manifold.chart.to_x(self._start)[None]
            apart = other is not None and other.component_of(home)[0] < 0
            proof = "the optimum is on another component of the self-motion" if apart else ""
        return Connection(None, reached, "continuation", proof)

    def lowest(self) -> Array:
        """Return the reached posture with the lowest objective, shape (nq,)."""
        from scipy.optimize import minimize_scalar

        space, value = self._space, self._space.problem.objective.value
        best = min((q for side, _ in self._sides for q in side), key=value)
        tangent = self._manifold.tangents(self._manifold.chart.to_x(best)[None], 1)[0, 0]

        def beside(step: float) -> Array:
            moved = space.pulled(best, step * tangent)
            return best if moved is None else moved

        minimum = minimize_scalar(lambda s: value(beside(s)), bounds=(-LONGEST_STEP, LONGEST_STEP), method="bounded")
        return min(best, beside(float(minimum.x)), key=value)

    def _side(self, nodes: Iterable[Array]) -> tuple[list[Array], bool]:
        """Return the postures reached along a side, and whether it ends at an invalid posture or at its last node."""
        path = [self._start]
        for x in nodes:
            q = self._space.unwound(path[-1], self._manifold.to_q(x))
            if not self._space.valid(q):
                return path, True
            if not self._space.clear(path[-1], q):
                return path, False
            path.append(q)
        return path, True

    def _along(self, side: list[Array], target: Array) -> list[Array]:
        """Return the part of a side from the start to ``target``; empty if the side does not pass ``target``."""
        points = self._manifold.embed(np.array([self._manifold.chart.to_x(q) for q in (target, *side)]))
        for k in np.argsort(np.linalg.norm(points[1:] - points[0], axis=1))[:2]:
            end = self._space.unwound(side[k], target)
            if self._space.distance(side[k], end) <= LONGEST_STEP and self._space.clear(side[k], end):
                return [*side[: k + 1], end]
        return []


def _followed(manifold: ConstraintManifold, q: Array) -> SelfMotion | None:
    """Return the self-motion through a posture if it is a closed curve or ends at limits."""
    x = manifold.chart.to_x(q)[None]
    if manifold.chart.nv - rank(manifold.equalities(x)[1][0]) != 1:
        return None
    motion = component_through(manifold, x[0])
    return motion if all(end in ("closed", "limit") for end in motion.components[0].ends) else None
