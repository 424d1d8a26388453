"""Postures that the constraints of a problem allow, and steps between them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import Chart
from impact_posture.posture.manifold.feasible_start import Projector
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from impact_posture.system.arrays import Array

# Largest violation of an equality at a valid posture (m, rad, or the unit of the constraint).
EQUALITY = 1e-6
# Largest violation of an inequality at a valid posture, in the same units.
INEQUALITY = 1e-8
# Largest motion of a frame of the robot between two checked postures, m.
CHECK_DISTANCE = 2e-2
# Largest number of steps that separate bodies.
_SEPARATIONS = 5
# Tangent length of a step along the constraints, rad mixed with m.
STEP = 0.05
# A step is stuck if it reduces the distance to the target by less than this fraction of the length of the step.
_PROGRESS = 0.05
# Largest ratio of the length of a step on the constraints to its planned length.  A longer step is a jump to another
# branch of the constraints.
_JUMP = 2.0
# Joint family → number of translations, which are the first velocity entries of a joint.
_SLIDING = {"free-flyer": 3, "planar": 2, "prismatic": 1, "translation": 3}


class PathSpace:
    """Postures on the constraints and within the joint limits of a problem, and checked motions between them.

    ``pulls`` is the number of postures that were pulled onto the constraints so far.
    """

    def __init__(self, problem: ConstrainedProblem) -> None:
        self.problem, self.model = problem, problem.robot.model
        self.projector = Projector(problem)
        self.pulls = 0
        self._inequalities = any(not c.equality for c in problem.constraints)
        self._reach = lever_arms(self.projector.chart, self.model)

    def violations(self, q: Array) -> list[tuple[str, float, float]]:
        """Return name, violation and tolerance of each constraint and of the joint limits at ``q``, shape (nq,)."""
        rows = self.problem.violations(self.projector.numeric.at(q))
        x = self.projector.chart.to_x(q)
        outside = np.abs(x - np.clip(x, self.problem.lower, self.problem.upper)).max(initial=0.0)
        by_constraint = [
            (c.name, float(np.abs(violation).max(initial=0.0)), EQUALITY if c.equality else INEQUALITY)
            for c, violation in zip(self.problem.constraints, rows, strict=True)
        ]
        return [*by_constraint, ("joint limits", float(outside), INEQUALITY)]

    def valid(self, q: Array) -> bool:
        """Return whether ``q``, shape (nq,), satisfies all constraints."""
        return all(size <= tolerance for _, size, tolerance in self.violations(q))

    def worst(self, q: Array) -> float:
        """Return the largest violation at ``q``, shape (nq,)."""
        return max(size for _, size, _ in self.violations(q))

    def difference(self, start: Array, end: Array) -> Array:
        """Return ``end ⊖ start``, shape (nv,)."""
        return np.array(pin.difference(self.model, start, end))

    def distance(self, start: Array, end: Array) -> float:
        """Return the tangent norm ``‖end ⊖ start‖``, rad mixed with m."""
        return float(np.linalg.norm(self.difference(start, end)))

    def pulled(self, q: Array, step: Array | None = None) -> Array | None:
        """Return ``q ⊕ step`` pulled onto the constraints, or ``None`` if it does not reach them."""
        self.pulls += 1
        moved = self.projector.project(q if step is None else np.asarray(pin.integrate(self.model, q, step)))
        # Without a violation, the posture satisfies the joint limits and all constraints onto which it was projected.
        satisfied = moved.violation <= min(EQUALITY, INEQUALITY)
        valid = self.projector.allows(moved.q, INEQUALITY) if satisfied else self.valid(moved.q)
        return moved.q if valid else None

    def apart(self, q: Array) -> Array | None:
        """Return a valid posture near ``q``, shape (nq,), at which bodies may be too near to each other, or ``None``.

        Linearized steps move the bodies apart, each by 1.25 times the violation of the clearance.
        """
        for _ in range(_SEPARATIONS):
            q = self.projector.project(q).q
            if self.valid(q):
                return q
            model = self.projector.numeric.at(q)
            excess, rows = np.zeros(0), equality_jacobian(self.problem, model)
            held = len(rows)
            for c in self.problem.constraints:
                if not c.projected:
                    value, jacobian = c.evaluate(model)
                    violated = np.flatnonzero(c.excess(value))
                    excess = np.append(excess, c.excess(value)[violated])
                    rows = np.vstack([rows, jacobian[violated]])
            step = np.linalg.pinv(rows, rcond=1e-6) @ np.append(np.zeros(held), -1.25 * excess)
            q = np.array(pin.integrate(self.model, q, step))
        return None

    def size(self, step: Array) -> float:
        """Return the size of a tangent step in units of the largest step between two successive checked postures.

        The size is the larger of two ratios.  The first is the largest motion of a frame divided by
        :data:`CHECK_DISTANCE`, and is omitted without inequalities.  The second is the tangent norm divided by twice
        the length of a step, :data:`STEP`.
        """
        moved = float(self._reach @ np.abs(step)) / CHECK_DISTANCE if self._inequalities else 0.0
        return max(moved, float(np.linalg.norm(step)) / (_JUMP * STEP))

    def checks(self, step: Array) -> int:
        """Return the number of equal parts of a tangent step between checks; the constraints may lengthen a part."""
        return max(1, int(np.ceil(_JUMP * self.size(step) - 1e-9)))

    def clear(self, start: Array, end: Array) -> bool:
        """Return whether the motion from ``start`` to ``end`` along the constraints is valid between its ends.

        The check pulls postures of the straight motion onto the constraints.  The motion is invalid if two successive
        postures differ by a step of a :meth:`size` above 1.
        """
        whole, q = self.difference(start, end), start
        parts = self.checks(whole)
        for k in range(1, parts + 1):
            moved = self.pulled(start, whole * (k / parts)) if k < parts else end
            if moved is None or self.size(self.difference(q, moved)) > 1:
                return False
            q = moved
        return True

    def clear_path(self, postures: Iterable[Array]) -> bool:
        """Return whether all postures of a path and all motions between them are valid."""
        path = list(postures)
        return all(map(self.valid, path)) and all(self.clear(a, b) for a, b in pairwise(path))

    def take(self, q: Array, step: Array) -> Array | None:
        """Return the posture after a step along the constraints; ``None`` if it is invalid or on another branch."""
        moved = self.pulled(q, step)
        if moved is None or self.distance(q, moved) > _JUMP * float(np.linalg.norm(step)):
            return None
        return moved if self.clear(q, moved) else None

    def walk(self, start: Array, target: Array, longest: float = np.inf) -> list[Array]:
        """Return postures along the constraints from ``start``, until no step comes nearer to ``target``.

        The last posture is ``target`` itself if the walk reaches it.  Inequalities deflect the steps, because the
        postures are also pulled onto the inequalities.  The walk also ends if the tangent length of the walk and of
        the remaining distance together exceed ``longest``.
        """
        path, walked = [start], 0.0
        while True:
            left = self.difference(path[-1], target)
            size = float(np.linalg.norm(left))
            if size <= STEP:
                if self.clear(path[-1], target):
                    path.append(target)
                return path
            moved = self.take(path[-1], left * (STEP / size)) if walked + size < longest else None
            if moved is None or self.distance(moved, target) > size - _PROGRESS * STEP:
                return path
            walked += self.distance(path[-1], moved)
            path.append(moved)

    def unwound(self, start: Array, target: Array) -> Array:
        """Return ``target`` with revolute joints moved by full turns towards ``start``, within their limits."""
        target = target.copy()
        for slot in self.projector.chart.slots:
            if slot.kind.family == "revolute" and slot.name not in self.problem.robot.coupled_joints:
                turns = np.round((target[slot.q] - start[slot.q]) / (2 * np.pi))
                nearer = target[slot.q] - 2 * np.pi * turns
                if ((self.problem.lower[slot.x] <= nearer) & (nearer <= self.problem.upper[slot.x])).all():
                    target[slot.q] = nearer
        return target

    def length(self, postures: Iterable[Array]) -> float:
        """Return the tangent length of a path, rad mixed with m."""
        return sum(self.distance(a, b) for a, b in pairwise(postures))


def lever_arms(chart: Chart, model: pin.Model) -> Array:
    """Return an upper bound on the motion of any frame per unit of each velocity entry, m/rad or 1, shape (nv,).

    For a rotation, the bound is the length of the longest chain of placements from the joint to a frame behind the
    joint, because no frame is farther from the joint axis.  Sliding joints on the chain add their largest travel.
    """
    depth = np.zeros(model.njoints)
    for frame in model.frames:
        depth[frame.parentJoint] = max(depth[frame.parentJoint], float(np.linalg.norm(frame.placement.translation)))
    arms = np.zeros(model.nv)
    for slot in reversed(chart.slots):
        sliding = _SLIDING.get(slot.kind.family, 0)
        arms[slot.v] = depth[slot.index]
        arms[slot.v.start : slot.v.start + sliding] = 1.0
        travel = 0.0
        if slot.kind.family in ("prismatic", "translation"):
            limits = np.abs(np.r_[model.lowerPositionLimit[slot.q], model.upperPositionLimit[slot.q]])
            travel = float(np.linalg.norm(limits[limits < 1e10]))
        parent = int(model.parents[slot.index])
        along = float(np.linalg.norm(model.jointPlacements[slot.index].translation))
        depth[parent] = max(depth[parent], depth[slot.index] + travel + along)
    return arms
