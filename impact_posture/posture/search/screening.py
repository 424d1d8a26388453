"""Screen many random postures by batch descents, hop from good final postures, and choose the starts of IPOPT.

The objective at a posture hardly predicts the optimum to which a descent leads, so each posture descends first
(:mod:`impact_posture.posture.manifold.batch_descent`).  A hop takes the posture where a good descent ended, gives
other values to some joints, and descends again (D. J. Wales and J. P. K. Doye, "Global optimization by
basin-hopping", J. Phys. Chem. A 1997), because many optima differ in a few joints only.  Hops from the best optimum
alone seldom reach another optimum.  The hops that reach a better optimum often start from worse final postures.  No
limit depends on time, so a seed determines the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import MetricError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.posture.manifold.batch_descent import BatchDescent, Ends
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.feasible_start import FEASIBLE, Projector
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.start_draws import StartDraws
from impact_posture.posture.search.unseen_optima import SAME_VALUE, groups_by_value, hits_by_value
from impact_posture.system.arrays import Array

# Number of descents that run together.  New descents begin when a quarter of these descents has ended.
_WIDTH = 512
# Largest fraction of all allowed descents that run together.  Otherwise, the first random postures of a large robot
# would leave none for hops.
_FIRST = 1 / 2
# This number of descents may always run together.  A smaller batch takes nearly as long, so talos would answer 0.5 s
# later.
_NARROW = 32
# When no more descents may begin, the search ends if the descents that still run are at most this fraction of the
# ended descents.  A small batch takes nearly as long as a large one.
_SLOWEST = 1 / 16
# Limit of the number of descents times the square of the degrees of freedom, because descents of large robots take
# longer.
_WORK = 800_000
# Degrees of freedom above which the limit falls with the tenth power instead.  A descent of a humanoid takes as long
# as ten descents of a quadruped.
_LARGE = 24
# Number of descents that are always allowed.
_LEAST = 16
# If less than this fraction of the first random postures reaches the equalities, the descents end at too similar
# postures.  Descents then also begin from starts that satisfy all constraints.
_REACHED = 0.4
# Number of these additional starts.
_FEASIBLE = 128
# Largest number of descents from the additional starts, as a fraction of all allowed descents.
_PART = 1 / 8
# Share of the new descents that are hops.
_HOPPING = 0.75
# A hop starts at an optimum with a probability proportional to ``(1 + rank)^-_RANKED / (1 + hops / _TIRED)²``.  The
# best optimum has the rank 0, and ``hops`` counts the earlier hops from this optimum.
_RANKED, _TIRED = 0.7, 8
# Fractions of the joints, rounded up, to which a hop gives other values; each hop draws one of these fractions.
_REDRAWN = (0.1, 0.2, 0.3, 0.5)
# Share of the hops that take the other values from another optimum.  All other hops draw random values.
_CROSSED = 0.6
# Distance (rad, m) below which two final postures are the same optimum if their merits differ by less than
# ``SAME_VALUE``.
_SAME = 0.05
# The search may stop when the best merit was reached from this number of random postures and worse final postures;
# ``_FREE``, ``_ENDS`` and ``_IDLE`` are further conditions.
_HITS = 24
# Degrees of freedom up to which ``_HITS`` suffices.  Each further degree of freedom doubles the number of hits,
# because the number of optima grows exponentially with the degrees of freedom.
_FREE = 5
# The search stops only after this number of descents, or after half of all allowed descents, has ended.
_ENDS = 256
# The search stops only if the last descents, this fraction of all ended descents, did not lower the best merit.
_IDLE = 0.5
# Number of starts of IPOPT: half of them at the best final postures, half at the most different good final postures.
# If descents ignored no constraint, a third of this number suffices.
_GUESSES = 12
# Limit of the number of starts times the degrees of freedom, because a solution takes longer for large robots.
_SOLVED = 200
# Tag of a descent from a random posture.  The tag of a hop is the index of the end where the hop started.
_RANDOM = -1


@dataclass(frozen=True)
class Screening:
    """Result of a screening.

    Attributes:
        guesses: Postures from which IPOPT starts, shape (nq,) each.
        hits: Number of random postures whose descents ended at each guess.
        groups: Index in ``values`` of the objective of each guess.
        values: For each distinct objective where descents ended, best first: the number of random postures that
            descended to it.  The last entries are 1, each for a random posture whose descent got stuck.
        partial: Whether the problem has constraints that descents ignore, such as clearances.
    """

    guesses: tuple[Array, ...]
    hits: tuple[int, ...]
    groups: tuple[int, ...]
    values: tuple[int, ...]
    partial: bool
    hops: int


def screenable(problem: ConstrainedProblem) -> bool:
    """Return whether the objective is an impact objective with expressions, without a regularization."""
    if not isinstance(problem.objective, WorstCaseObjective) or problem.requirements.regularization:
        return False
    try:
        problem.objective.check_expressions()
    except MetricError:
        return False
    return True


def screen(problem: ConstrainedProblem, initial: Array, most: int, seed: int) -> Screening:
    """Screen at most ``most`` random postures and hops, some of them near the posture ``initial``, shape (nq,)."""
    search = _Search(problem, initial, seed)
    nv = problem.robot.nv
    most = min(most, max(_LEAST, int(_WORK / nv**2 * min(_LARGE / nv, 1) ** 8)))
    width, drawn = min(_WIDTH, most, max(int(_FIRST * most), _NARROW)), 0
    while True:
        room = width - search.descent.active
        if room >= width // 4:
            if search.settled(max(min(_ENDS, most // 2), 1)):
                break
            count = min(room, most - drawn)
            search.begin(count)
            if not drawn and search.descent.active < _REACHED * count:
                search.begin_feasible(min(_FEASIBLE, int(_PART * most)), seed)
            drawn += count
            if drawn == most and search.descent.active <= _SLOWEST * len(search.ends.x):
                break
        search.step()
    return search.result()


class _Search:
    def __init__(self, problem: ConstrainedProblem, initial: Array, seed: int) -> None:
        self.descent = BatchDescent(ConstraintManifold(problem))
        self._manifold = self.descent.manifold
        self.ends = Ends(np.zeros((0, self._manifold.chart.nx)), np.zeros(0), np.zeros(0, dtype=int))
        self._problem, self._initial, self._rng = problem, initial, np.random.default_rng([seed, 2])
        # One entry per optimum: index of a descent that ended there, merit and embedded posture at its end, number of
        # random postures that reached the optimum, and number of hops from the optimum.
        self._end, self._merit = np.zeros(0, dtype=int), np.zeros(0)
        self._points = np.zeros((0, self._manifold.embed(self.ends.x).shape[1]))
        self._hits, self._tries = np.zeros(0, dtype=int), np.zeros(0, dtype=int)
        self._hops = 0

    def begin(self, count: int) -> None:
        if not count:
            return
        x, tag = self._manifold.draw(self._rng, count, self._initial), np.full(count, _RANDOM)
        hops = int(_HOPPING * count) if len(self.ends.x) else 0
        if hops:
            x[:hops], tag[:hops] = self._hop(x[:hops])
            self._hops += hops
        self.descent.add(x, tag)

    def begin_feasible(self, count: int, seed: int) -> None:
        draws = StartDraws(self._problem, (self._initial,), count + 1, seed)
        starts = [q for k in range(count) if (q := draws.choose(k + 1)) is not None]
        x = np.array([self._manifold.chart.to_x(q) for q in starts]).reshape(-1, self._manifold.chart.nx)
        self.descent.add(x, np.full(len(x), _RANDOM))

    def step(self) -> None:
        """Continue all descents, and count the random postures that reached each optimum."""
        ends = self.descent.step()
        first, self.ends = len(self.ends.x), self.ends.joined(ends)
        for k, point in enumerate(self._manifold.embed(ends.x)):
            same = np.flatnonzero(np.abs(self._merit - ends.merit[k]) < SAME_VALUE)
            same = same[np.linalg.norm(self._points[same] - point, axis=1) < _SAME]
            if not same.size:
                same = np.array([len(self._end)])
                self._end, self._merit = np.append(self._end, first + k), np.append(self._merit, ends.merit[k])
                self._points = np.concatenate([self._points, point[None]])
                self._hits, self._tries = np.append(self._hits, 0), np.append(self._tries, 0)
            self._hits[same[0]] += ends.tag[k] == _RANDOM

    def settled(self, least: int) -> bool:
        """Return whether the best merit was reached ``_HITS`` times or more, and not only by the last descents."""
        merit, tag = self.ends.merit, self.ends.tag
        if len(merit) < least:
            return False
        best = merit <= merit.min() + SAME_VALUE
        hits = int((best & ((tag == _RANDOM) | ~best[tag])).sum())
        enough = _HITS * 2 ** max(self._manifold.free - _FREE, 0)
        return hits >= enough and bool(best.argmax() < (1 - _IDLE) * len(merit))

    def result(self) -> Screening:
        order = np.argsort(self._merit, kind="stable")
        projector, guesses = Projector(self._problem), dict[int, Array]()
        partial = not all(isinstance(c, ExpressionConstraint) for c in self._problem.constraints)
        count = min(_GUESSES if partial else _GUESSES // 3, _SOLVED // self._problem.robot.nv)
        for k in order[_best_and_different(self._points[order], max(count, 2))]:
            projection = projector.project(self._manifold.to_q(self.ends.x[self._end[k]]))
            if projection.violation <= FEASIBLE:
                guesses[k] = projection.q
        # The ends of the stuck descents are unknown, so each counts as an objective with one hit.
        stuck = (1,) * int((self.descent.stuck == _RANDOM).sum())
        values = hits_by_value(self.ends.merit, self.ends.tag == _RANDOM) + stuck
        hits, groups = tuple(int(self._hits[k]) for k in guesses), groups_by_value(self.ends.merit)
        of_guesses = tuple(int(groups[self._end[k]]) for k in guesses)
        return Screening(tuple(guesses.values()), hits, of_guesses, values, partial, self._hops)

    def _hop(self, other: Array) -> tuple[Array, NDArray[np.int_]]:
        """Return hops, shape (N, nx), and the descents that they start from; ``other`` are random postures."""
        rng, count = self._rng, len(other)
        rank = np.argsort(np.argsort(self._merit))
        weight = (1 + rank) ** -_RANKED / (1 + self._tries / _TIRED) ** 2
        optimum, another = rng.choice(len(weight), size=(2, count), p=weight / weight.sum())
        self._tries += np.bincount(optimum, minlength=len(weight))
        joints = [slot for slot in self._manifold.chart.slots if slot.kind.family != "free-flyer"]
        number = np.ceil(rng.choice(_REDRAWN, size=(count, 1)) * len(joints))
        chosen = rng.random((count, len(joints))).argsort(axis=1).argsort(axis=1) < number
        redrawn = np.zeros(other.shape, dtype=bool)
        for slot, rows in zip(joints, chosen.T, strict=True):
            redrawn[rows, slot.x] = True
        crossed = rng.random((count, 1)) < _CROSSED
        other = np.where(crossed, self.ends.x[self._end[another]], other)
        return np.where(redrawn, other, self.ends.x[self._end[optimum]]), self._end[optimum]


def _best_and_different(points: Array, count: int) -> list[int]:
    """Choose the best postures, then postures of the better half that are farthest from all chosen postures."""
    chosen = list(range(min(len(points), count // 2)))
    half = np.arange(len(points)) < max(count, len(points) // 2)
    while len(chosen) < min(count, int(half.sum())):
        distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
        distance[chosen] = -1.0
        chosen.append(int(np.where(half, distance, -1.0).argmax()))
    return chosen
