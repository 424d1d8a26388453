"""A sampling planner on the constraints, for targets that no walk reaches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.path.path_space import STEP, PathSpace
from impact_posture.posture.problem import rank

# Room of unbounded coordinates beyond both ends of the path, rad or m.
_ROOM = {"continuous": np.pi, "free-flyer": 0.7, "planar": 1.0, "spherical": 1.0}
# Largest residual of the equalities at a sample, far below what a valid posture may violate.
_TOLERANCE = 1e-8


def sampled_path(space: PathSpace, start: Array, target: Array, seed: int, evaluations: int) -> list[Array] | None:
    """Return postures from ``start`` to ``target`` by RRT-Connect on the constraint manifold, or ``None``.

    OMPL plans in tangent coordinates ``z`` at the start, ``q = start ⊕ z``, without the held joints.  It projects
    samples on the manifold of the equalities (``ProjectedStateSpace``).  Inequalities and joint limits make a sample
    valid or not.  The effort is counted and not timed, so that the result depends on the seed alone.

    Args:
        space: The postures that the constraints allow.
        start: First posture, shape (nq,), valid.
        target: Last posture, shape (nq,), valid.
        seed: Seed of the samples.
        evaluations: Number of evaluations of the constraints after which the search ends.
    """
    from ompl import base, geometric, util

    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed + 1)
    manifold = _Manifold(space, start)

    class Equalities(base.Constraint):  # type: ignore[misc]
        def function(self, z: Array, out: Array) -> None:
            out[:] = manifold.equalities(z)[0]

        def jacobian(self, z: Array, out: Array) -> None:
            out[:, :] = manifold.equalities(z)[1]

    ambient, bounds = base.RealVectorStateSpace(manifold.size), base.RealVectorBounds(manifold.size)
    goal = manifold.coordinates(target)
    for i, (low, high) in enumerate(zip(*manifold.bounds(goal), strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    ambient.setBounds(bounds)
    equalities = Equalities(manifold.size, manifold.rows)
    equalities.setTolerance(_TOLERANCE)
    states = base.ProjectedStateSpace(ambient, equalities)
    information = base.ConstrainedSpaceInformation(states)
    setup = geometric.SimpleSetup(information)
    setup.setStateValidityChecker(lambda state: space.valid(manifold.posture(manifold.read(state))))
    first, last = states.allocState(), states.allocState()
    first.copy([0.0] * manifold.size)
    last.copy(goal.tolist())
    setup.setStartAndGoalStates(first, last)
    states.setDelta(STEP)
    setup.setPlanner(geometric.RRTConnect(information))
    setup.setup()
    setup.solve(base.PlannerTerminationCondition(lambda: manifold.evaluations > evaluations))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    path.interpolate()
    between = [manifold.posture(manifold.read(state)) for state in path.getStates()]
    postures = [start, *[space.projector.project(q).q for q in between[1:-1]], target]
    return postures if all(map(space.valid, postures)) and space.clear_path(postures) else None


class _Manifold:
    """The manifold of the equalities in tangent coordinates ``z`` at a posture, without the held joints."""

    def __init__(self, space: PathSpace, start: Array) -> None:
        self._space, self._start = space, start
        self._held = [c for c in space.problem.constraints if c.equality]
        self.size, self.evaluations = int(space.free.sum()), 0
        self._last: tuple[bytes, tuple[Array, Array]] | None = None
        self._rows = np.eye(sum(c.rows for c in self._held))
        jacobian = self.equalities(np.zeros(self.size))[1]
        # Rows that repeat others (two frames on one link) would leave the planner no dimension.
        self._rows = np.linalg.svd(jacobian)[0][:, : rank(jacobian)].T
        self.rows, self._last = len(self._rows), None

    def read(self, state: Any) -> Array:
        return np.array([state[i] for i in range(self.size)])

    def posture(self, z: Array) -> Array:
        return np.asarray(pin.integrate(self._space.model, self._start, self._step(z)))

    def coordinates(self, q: Array) -> Array:
        return np.asarray(self._space.difference(self._start, q)[self._space.free])

    def equalities(self, z: Array) -> tuple[Array, Array]:
        """Return the independent equalities and their Jacobian by ``z``; OMPL asks for both, one after the other."""
        if self._last is not None and self._last[0] == z.tobytes():
            return self._last[1]
        self.evaluations += 1
        space = self._space
        numeric = space.projector.numeric.at(self.posture(z))
        found = [c.evaluate(numeric) for c in self._held]
        values = np.concatenate([np.zeros(0), *[c.excess(v) for c, (v, _) in zip(self._held, found, strict=True)]])
        jacobian = np.vstack([np.zeros((0, space.model.nv)), *[J for _, J in found]])
        turn = pin.dIntegrate(space.model, self._start, self._step(z), pin.ARG1)
        self._last = z.tobytes(), (self._rows @ values, self._rows @ (jacobian @ turn)[:, space.free])
        return self._last[1]

    def bounds(self, goal: Array) -> tuple[Array, Array]:
        """Return bounds of ``z``: the joint limits, or the box around start and goal with some room."""
        space, problem = self._space, self._space.problem
        low, high, x = np.zeros(space.model.nv), np.zeros(space.model.nv), space.projector.chart.to_x(self._start)
        far = np.zeros(space.model.nv)
        far[space.free] = goal
        for slot in space.projector.chart.slots:
            room = _ROOM.get(slot.kind.family, np.pi)
            low[slot.v], high[slot.v] = np.minimum(far[slot.v], 0) - room, np.maximum(far[slot.v], 0) + room
            if slot.v.stop - slot.v.start == slot.x.stop - slot.x.start:
                bounded = problem.lower[slot.x] - x[slot.x], problem.upper[slot.x] - x[slot.x]
                low[slot.v] = np.where(np.isfinite(bounded[0]), bounded[0], low[slot.v])
                high[slot.v] = np.where(np.isfinite(bounded[1]), bounded[1], high[slot.v])
        return low[space.free], high[space.free]

    def _step(self, z: Array) -> Array:
        step = np.zeros(self._space.model.nv)
        step[self._space.free] = z
        return step
