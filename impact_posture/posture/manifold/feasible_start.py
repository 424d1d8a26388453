"""Feasible starts: random postures that are projected onto the constraint manifold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, held_rows
from impact_posture.system.arrays import Array

# A constraint is treated as satisfied if its violation is at most this value (m, rad).
FEASIBLE = 1e-8
# Maximum number of random postures that are projected onto the constraints for one start.
ATTEMPTS = 20
_STEPS = 80
# The projection stops if the violation decreases by less than a fifth within this number of steps, because the
# projection would probably not converge.
_PATIENCE = 16
# Maximum number of projected postures among which one start is chosen.
CANDIDATES = 3
# Standard deviations of the base of a floating robot in random postures: position, m, and rotation, rad.
BASE_SPREAD = np.array([0.15, 0.15, 0.15, 0.15, 0.15, 0.6])
# Fraction of the trace that is added to the diagonal of a matrix, because the matrix may be singular.
ROUNDING = 1e-13


@dataclass(frozen=True)
class Projection:
    """A projected posture, and its largest remaining violation (m, rad, or the unit of the constraint)."""

    q: Array
    violation: float


class Projector:
    """Levenberg–Marquardt projection onto all constraints whose ``projected`` is true; held joints do not move."""

    def __init__(self, problem: ConstrainedProblem) -> None:
        self.problem = problem
        self.numeric = Numeric(problem.robot.model)
        self.chart = Chart.of(problem.robot.model)
        self._held = held_rows(problem.robot, problem.requirements.hold).sum(axis=0) > 0
        self._in_v, self._in_x = (np.array(places, dtype=int) for places in self.chart.bounded)
        self._low, self._high = problem.lower[self._in_x], problem.upper[self._in_x]
        self._projected = [(c, c.equality) for c in problem.constraints if c.projected]
        self._free = [c for c in problem.constraints if not c.projected]

    def clip(self, q: Array) -> Array:
        """Clamp ``q`` to the joint limits."""
        return self.chart.to_q(self._clipped(q))

    def _clipped(self, q: Array) -> Array:
        return np.minimum(np.maximum(self.chart.to_x(q), self.problem.lower), self.problem.upper)

    def residual(self, q: Array) -> tuple[Array, Array]:
        """Return violations and Jacobian of all rows at ``q``; both are zero for a satisfied inequality."""
        self.numeric.at(q)
        values, jacobians = [np.zeros(0)], [np.zeros((0, self.problem.robot.nv))]
        for constraint, equality in self._projected:
            value, jacobian = constraint.evaluate(self.numeric)
            violation = value - constraint.lower if equality else constraint.excess(value)
            values.append(violation)
            if not equality:
                jacobian = np.where((violation != 0)[:, None], jacobian, 0.0)
            jacobians.append(jacobian)
        return np.concatenate(values), np.concatenate(jacobians)

    def allows(self, q: Array, tolerance: float) -> bool:
        """Return whether the constraints that are not projected are violated by at most ``tolerance``."""
        self.numeric.at(q)
        return all(np.abs(c.excess(c.value(self.numeric))).max(initial=0.0) <= tolerance for c in self._free)

    def outside(self, q: Array, most: float = np.inf) -> float:
        """Return the sum of the violations of all constraints that are not projected.

        If the sum exceeds ``most``, the result may be any value above ``most``.
        """
        self.numeric.at(q)
        total = 0.0
        for constraint in self._free:
            if total >= most:
                break
            total += float(np.abs(constraint.excess(constraint.value(self.numeric))).sum())
        return total

    def project(self, q: Array, tolerance: float = 1e-9) -> Projection:
        """Project ``q`` onto the constraints; the result may still violate the constraints."""
        x = self._clipped(q)
        q = self.chart.to_q(x)
        value, jacobian = self.residual(q)
        squared = float(value @ value)
        damping, norms, moved = 1e-3, list[float](), True
        for _ in range(_STEPS):
            size = float(np.abs(value).max(initial=0.0))
            norms.append(squared**0.5)
            stuck = len(norms) > _PATIENCE and norms[-1] > 0.8 * norms[-1 - _PATIENCE]
            if size < tolerance or damping > 1e6 or stuck:
                break
            if moved:
                free = jacobian.copy()
                free[:, self._held | self._blocked(x, -jacobian.T @ value)] = 0.0
                gram = free @ free.T
                diagonal = gram.reshape(-1)[:: len(gram) + 1]
                plain = diagonal.copy()
                # If two frames are on one link, a row can occur twice, and the matrix is singular.  The damping must
                # therefore exceed rounding errors.
                least = ROUNDING * max(1.0, float(plain.sum()))
            diagonal[:] = plain + (damping * min(1.0, size) + least)
            step = -free.T @ np.linalg.solve(gram, value)
            step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-12))
            new_x = self._clipped(pin.integrate(self.problem.robot.model, q, step))
            candidate = self.chart.to_q(new_x)
            new_value, new_jacobian = self.residual(candidate)
            new_squared = float(new_value @ new_value)
            moved = new_squared < squared
            if moved:
                x, q, value, jacobian, squared = new_x, candidate, new_value, new_jacobian, new_squared
                damping = max(damping / 5, 1e-9)
            else:
                damping = max(damping * 10, 1e-6)
        return Projection(q, float(np.abs(value).max(initial=0.0)))

    def _blocked(self, x: Array, direction: Array) -> NDArray[np.bool_]:
        """Return a mask, shape (nv,), of the joints that ``direction`` would move beyond a limit."""
        at, along = x[self._in_x], direction[self._in_v]
        at_low = (at <= self._low + 1e-12) & (along < 0)
        at_high = (at >= self._high - 1e-12) & (along > 0)
        blocked = np.zeros(self.problem.robot.nv, dtype=bool)
        blocked[self._in_v] = at_low | at_high
        return blocked


def feasible_start(problem: ConstrainedProblem, index: int, seed: int, candidates: int = CANDIDATES) -> Array | None:
    """Return the ``index``-th feasible start of a seed, or ``None`` if no attempt reached the constraints.

    Start 0 is the given posture, projected onto the constraints.  For any other start, ``candidates`` postures are
    projected (:class:`StartDraw`), and the posture that violates the remaining constraints least is returned.
    """
    if index == 0:
        projection = Projector(problem).project(problem.given)
        return projection.q if projection.violation <= FEASIBLE else None
    return StartDraw(problem, index, seed).choose(candidates)


class StartDraw:
    """The random postures of one start, projected onto the constraints, and drawn when they are needed.

    Starts with an odd index lie near the posture ``around``, by default the given posture.  Starts with an even index
    lie anywhere within the limits.  Near starts reach the constraints more often; far starts lead to other optima.
    ``projector`` may belong to the same problem with fewer rows in its program.
    """

    def __init__(
        self,
        problem: ConstrainedProblem,
        index: int,
        seed: int,
        around: Array | None = None,
        projector: Projector | None = None,
    ) -> None:
        self._problem, self._index = problem, index
        self._around = problem.given if around is None else around
        self._projector = projector or Projector(problem)
        self._rng = np.random.default_rng([seed, index])
        self._attempts = self._tried = 0
        self._best: Array | None = None
        self._least = np.inf

    def choose(self, candidates: int) -> Array | None:
        """Return the best of ``candidates`` projected postures, including postures of earlier calls."""
        while self._attempts < ATTEMPTS and self._tried < candidates and self._least > FEASIBLE:
            near = self._around if (self._index + self._attempts) % 2 else None
            self._attempts += 1
            posture = random_posture(self._problem, self._projector.chart, self._rng, near)
            projection = self._projector.project(posture)
            if projection.violation <= FEASIBLE:
                outside = self._projector.outside(projection.q, self._least)
                self._tried += 1
                if outside < self._least:
                    self._best, self._least = projection.q, outside
        return self._best


def random_posture(
    problem: ConstrainedProblem, chart: Chart, rng: np.random.Generator, near: Array | None = None
) -> Array:
    """Return a random posture near ``near``, or anywhere within the limits; constraints are ignored."""
    model = problem.robot.model
    base = problem.robot.first_joint
    if near is not None:
        return np.asarray(pin.integrate(model, near, near_steps(rng, (model.nv,), base)))
    x, ranges = chart.to_x(problem.given), draw_ranges(problem, chart)
    x[ranges.entries] = rng.uniform(ranges.lower, ranges.upper)
    q = chart.to_q(x)
    if base:
        step = np.zeros(model.nv)
        step[:base] = rng.normal(size=base) * BASE_SPREAD
        q = pin.integrate(model, q, step)
    return np.asarray(q)


class DrawRanges(NamedTuple):
    """Entries of the chart coordinates that are drawn within limits, and the limits, shape (k,) each."""

    entries: NDArray[np.int_]
    lower: Array
    upper: Array


def draw_ranges(problem: ConstrainedProblem, chart: Chart) -> DrawRanges:
    """Return the ranges of random postures; a joint without limits gets a full turn or ±1 m."""
    entries, spans = list[int](), list[float]()
    for slot in chart.slots:
        if slot.kind.family in ("revolute", "prismatic", "translation"):
            entries += range(slot.x.start, slot.x.stop)
            spans += [np.pi if slot.kind.family == "revolute" else 1.0] * (slot.x.stop - slot.x.start)
        elif slot.kind.family in ("continuous", "planar"):
            entries.append(slot.x.stop - 1)
            spans.append(np.pi)
    low, high, span = problem.lower[entries], problem.upper[entries], np.array(spans)
    high = np.where(np.isfinite(high), high, span)
    return DrawRanges(np.array(entries, dtype=int), np.minimum(np.where(np.isfinite(low), low, -span), high), high)


def near_steps(rng: np.random.Generator, shape: tuple[int, ...], base: int) -> Array:
    """Draw tangent vectors that lead to near postures, shape (..., nv); the first ``base`` entries are smaller."""
    step = rng.normal(size=shape) * rng.uniform(0.1, 0.8, (*shape[:-1], 1))
    step[..., :base] *= 0.2
    return np.asarray(step)
