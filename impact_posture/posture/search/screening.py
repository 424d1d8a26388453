"""Screen many random postures by batch descents, hop from the best, and choose the starts of IPOPT.

The objective at a posture hardly predicts the optimum below it, so each posture descends first
(:mod:`impact_posture.posture.manifold.batch_descent`).  A hop gives random values to some joints of one of the best
ends and descends from there (D. J. Wales and J. P. K. Doye, "Global optimization by basin-hopping", J. Phys. Chem. A
1997), because many optima differ in a few joints only.  All limits are counts, so a seed determines the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.posture.manifold.batch_descent import BatchDescent, Ends
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.feasible_start import FEASIBLE, Projector, random_posture
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.unseen_optima import SAME_VALUE, hits_by_value
from impact_posture.system.arrays import Array

# Number of descents under way.  New descents begin when a quarter of them has ended.
_WIDTH = 256
# The number of descents, times the third power of the degrees of freedom, is limited by the first number, because
# descents of large robots take longer.  At least the second number is allowed.
_WORK, _LEAST = 1_300_000, 16
# Share of the random postures near the initial posture, and of the new descents that are hops.
_NEAR, _HOPPING = 0.25, 0.5
# Number of best ends from which hops start, and shares of the joints to which a hop gives random values.
_ELITE, _REDRAWN = 4, (0.1, 0.25, 0.5)
# Distance (rad, m) below which two ends are the same optimum if their merits differ by less than SAME_VALUE.
_SAME = 0.05
# The search stops when the best end was hit this often, and no better end was reached in the last share of all
# descents.
_HITS, _IDLE = 3, 0.5
# Number of starts of IPOPT, half of them at the best ends and half at the most different good ends.  The number,
# times the degrees of freedom, is limited by the second number, because a solution takes longer for large robots.
_GUESSES, _SOLVED = 12, 200


@dataclass(frozen=True)
class Screening:
    """Result of a screening.

    Attributes:
        guesses: Postures from which IPOPT starts, shape (nq,) each.
        hits: Number of random postures that descended to each guess.
        values: For each distinct objective where descents ended, best first: the number of random postures that
            descended to it.
        partial: Whether the problem has constraints that descents ignore, such as clearances.
        hops: Number of hops.
    """

    guesses: tuple[Array, ...]
    hits: tuple[int, ...]
    values: tuple[int, ...]
    partial: bool
    hops: int


def screenable(problem: ConstrainedProblem) -> bool:
    """Return whether the objective is an impact objective without a regularization."""
    return isinstance(problem.objective, WorstCaseObjective) and not problem.requirements.regularization


def screen(problem: ConstrainedProblem, initial: Array, most: int, seed: int) -> Screening:
    """Screen at most ``most`` random postures and hops, some of them near the posture ``initial``, shape (nq,)."""
    search = _Search(problem, initial, seed)
    most = min(most, max(_LEAST, _WORK // problem.robot.nv**3))
    width, drawn = min(_WIDTH, most), 0
    while True:
        room = width - search.descent.active
        if room >= width // 4:
            if search.settled(max(width // 2, 1)):
                break
            count = min(room, most - drawn)
            search.begin(count)
            drawn += count
            if not search.descent.active:
                break
        search.ends = search.ends.joined(search.descent.step())
    return search.result()


class _Search:
    def __init__(self, problem: ConstrainedProblem, initial: Array, seed: int) -> None:
        self.descent = BatchDescent(ConstraintManifold(problem))
        self.ends = Ends(np.zeros((0, self.descent.manifold.chart.nx)), np.zeros(0), np.zeros(0, dtype=int))
        self._problem, self._initial, self._rng = problem, initial, np.random.default_rng([seed, 2])
        self._hops = 0

    def begin(self, count: int) -> None:
        """Begin random descents and hops."""
        if not count:
            return
        hops = int(_HOPPING * count) if len(self.ends.x) else 0
        x = self._random(count)
        if hops:
            x[:hops] = self._hop(x[:hops])
            self._hops += hops
        self.descent.add(x, (np.arange(count) < hops).astype(int))

    def settled(self, least: int) -> bool:
        """Return whether the best end was hit often enough, and reached early enough."""
        if len(self.ends.x) < least:
            return False
        best = np.flatnonzero(self.ends.merit <= self.ends.merit.min() + SAME_VALUE)
        hits = int((self.ends.tag[best] == 0).sum())
        return hits >= _HITS and bool(best[0] < (1 - _IDLE) * len(self.ends.x))

    def result(self) -> Screening:
        """Return the guesses and the hits of all ends."""
        manifold = self.descent.manifold
        leaders, label = self._optima()
        hits = np.bincount(label[self.ends.tag == 0], minlength=len(leaders))
        projector, guesses = Projector(self._problem), dict[int, Array]()
        count = min(_GUESSES, _SOLVED // self._problem.robot.nv)
        for k in _best_and_different(manifold.embed(self.ends.x[leaders]), max(count, 2)):
            projection = projector.project(manifold.to_q(self.ends.x[leaders[k]]))
            if projection.violation <= FEASIBLE:
                guesses[k] = projection.q
        values = hits_by_value(self.ends.merit, self.ends.tag == 0)
        partial = not all(isinstance(c, ExpressionConstraint) for c in self._problem.constraints)
        return Screening(tuple(guesses.values()), tuple(int(hits[k]) for k in guesses), values, partial, self._hops)

    def _optima(self, most: int | None = None) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Return the indices of distinct ends, best first, and for each end the position of its optimum in them."""
        points, merit = self.descent.manifold.embed(self.ends.x), self.ends.merit
        leaders, label = list[int](), np.full(len(merit), -1)
        for k in np.argsort(merit, kind="stable"):
            near = np.linalg.norm(points[leaders] - points[k], axis=1) < _SAME
            near &= merit[k] - merit[leaders] < SAME_VALUE
            if near.any():
                label[k] = int(near.argmax())
                continue
            if len(leaders) == most:
                break
            label[k] = len(leaders)
            leaders.append(int(k))
        return np.array(leaders, dtype=int), label

    def _hop(self, other: Array) -> Array:
        """Return postures of the best ends with some joints of the postures ``other``, shape (N, nx)."""
        rng, slots = self._rng, self.descent.manifold.chart.slots
        leaders, _ = self._optima(_ELITE)
        x = self.ends.x[leaders[rng.integers(len(leaders), size=len(other))]]
        share = rng.choice(_REDRAWN, size=len(other))
        redrawn = np.zeros(x.shape, dtype=bool)
        for slot in slots:
            if slot.kind.family != "free-flyer":
                redrawn[:, slot.x] = (rng.random(len(other)) < share)[:, None]
        return np.where(redrawn, other, x)

    def _random(self, count: int) -> Array:
        chart, near = self.descent.manifold.chart, self._rng.random(count) < _NEAR
        drawn = [random_posture(self._problem, chart, self._rng, self._initial if k else None) for k in near]
        return np.array([chart.to_x(q) for q in drawn])


def _best_and_different(points: Array, count: int) -> list[int]:
    """Return the first postures, then postures of the better half that are farthest from all chosen postures."""
    chosen = list(range(min(len(points), count // 2)))
    half = np.arange(len(points)) < max(count, len(points) // 2)
    while len(chosen) < min(count, int(half.sum())):
        distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
        distance[chosen] = -1.0
        chosen.append(int(np.where(half, distance, -1.0).argmax()))
    return chosen
