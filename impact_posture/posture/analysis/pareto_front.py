"""The Pareto front of objective and distance from the initial posture, or of objective and peak force.

::

    f(d) = min over q  objective(q)    subject to the constraints of the problem and price(q) ≤ d

The price is the distance ‖q ⊖ q₀‖ of :func:`~impact_posture.posture.constraints.posture_distance.distance_squared`,
or the peak force of the impact.  The bound d goes from the least price to the price of the optimum.  The price is
bounded and not penalized, because minimizers of ``objective + w·price`` give only points on the convex hull of the
curve.

One program is used for all d, because d is the bound of a row of the program.  The problems for all bounds d are
solved in two orders: from the least bound to the greatest, and from the greatest to the least.  Each solve starts at
the result of the previous solve.  If this result satisfies the new bound, the solve also uses the multipliers of the
previous solve.  For each bound, the best certified result is kept.  If the best result for a neighboring bound comes
from the other order, one more solve starts from this result.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from impact_posture.config.checked import checked
from impact_posture.config.demand import OneOrMore
from impact_posture.config.problem_settings import TRADEOFF_POINTS
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.elasticity.contact_compression import ContactStiffness
from impact_posture.posture.analysis.least_force import least_effective_mass
from impact_posture.posture.analysis.trade_off import TradeOff, TradePoint, find_knee
from impact_posture.posture.analysis.trade_off_price import DistancePrice, ForcePrice, TradeOffPrice
from impact_posture.posture.program.certificate import Certificate, certify
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import PostureNLP, WarmStart, build_nlp
from impact_posture.posture.search.growing_search import Progress, run_start
from impact_posture.posture.search.multistart import PostureSolution
from impact_posture.system.arrays import Array

# Two prices count as equal if their difference is below this value: relative for a force, in rad or m for a distance.
_STILL = 1e-6
# One posture is better than another if its objective is lower by more than this fraction of the initial objective.
_EQUAL = 1e-9
# If the objective increases along the curve by more than this fraction of the initial objective, a note is added.
_RISE = 1e-6
# Maximum number of optima, besides the best optimum, from which solves for decreasing bounds start.
_PATHS = 3
# Maximum number of rounds in which solves start from results for neighboring bounds.
_ROUNDS = 3
# Maximum number of times that missing rows are added to the program for one bound.
_GROWTH = 8
# Number of starts of the search for the posture with the least force.
_FORCE_STARTS = 8


@checked
def pareto_front(
    solution: PostureSolution,
    points: OneOrMore = TRADEOFF_POINTS,
    *,
    force: tuple[ContactStiffness, float] | None = None,
    compile: CompileMode = "auto",
    progress: Progress | None = None,
) -> TradeOff:
    """Compute the trade-off curve in ``points`` equal steps of the price, which is the distance or the peak force.

    The objective is computed without regularization, because the bound on the distance has the same purpose.
    ``force`` contains the contact and the approach speed (m/s), from which the peak force is computed.  If ``force``
    is ``None``, the price is the distance.  ``progress`` is called with the numbers of finished and planned solves.

    Raises:
        InputError: The number of points is below 1, or the price is the force and there are several contacts.
    """
    problem = solution.problem
    price = _price(solution, force, compile)
    least, most = price.measure(price.nearest), price.measure(solution.q)
    bounded = _bounded(problem, price)
    if most - least < _STILL * max(1.0, least):
        curve = _Curve(bounded, None, price, [least])
        return curve.finish(solution, 0.0, 0.0, [f"trade-off: {price.nothing}, nothing to trade"])
    nlp = build_nlp(bounded, compile=compile, starts=2 * points)
    began = time.perf_counter()
    levels = [float(v) for v in least + (most - least) * np.arange(points + 1) / points]
    curve = _Curve(bounded, nlp, price, levels, compile)
    curve.follow(solution, progress)
    return curve.finish(solution, time.perf_counter() - began, nlp.build_time_s, [])


def _price(
    solution: PostureSolution, force: tuple[ContactStiffness, float] | None, compile: CompileMode
) -> TradeOffPrice:
    problem = solution.problem
    if force is None:
        return DistancePrice(problem.robot.model, solution.initial)
    objective, (contact, speed) = problem.impact, force
    if objective.others:
        fault = "bounds the force of one contact, but there are several contacts"
        raise InputError(fault, where="tradeoff_against", hint="give one `contact`")
    least = least_effective_mass(problem, starts=_FORCE_STARTS, compile=compile, guesses=[solution.q])
    return ForcePrice(objective, contact, speed, least.q)


def _bounded(problem: ConstrainedProblem, price: TradeOffPrice) -> ConstrainedProblem:
    """Return the problem with the bound on the price as its last constraint, and without regularization."""
    return replace(
        problem,
        requirements=replace(problem.requirements, regularization=0.0),
        constraints=(*problem.constraints, price.bound(1.0)),
        rows=(*problem.rows, (0,)) if problem.rows else (),
    )


@dataclass(frozen=True, eq=False)
class _End:
    """The result of a solve; ``path`` is the order of bounds, ``outward`` (increasing) or ``inward``."""

    path: str
    point: TradePoint

    @property
    def rank(self) -> tuple[bool, float]:
        return not self.point.certified, self.point.objective


class _Curve:
    """A trade-off curve while it is computed, with the best result so far for each bound."""

    def __init__(
        self,
        problem: ConstrainedProblem,
        nlp: PostureNLP | None,
        price: TradeOffPrice,
        levels: list[float],
        compile: CompileMode = "auto",
    ) -> None:
        self._problem, self._nlp, self._price, self._levels, self._compile = problem, nlp, price, levels, compile
        self._scale = problem.objective.value(price.nearest)
        self._best: list[_End | None] = [None] * len(levels)
        self._tried: set[tuple[int, bytes]] = set()
        # Posture of each result (as bytes) → warm start from this result.
        self._ends: dict[bytes, WarmStart] = {}
        self.solves = 0
        self._take(0, "outward", price.nearest)

    def follow(self, solution: PostureSolution, progress: Progress | None) -> None:
        """Solve from the least price for increasing bounds, and from the best optima for decreasing bounds."""
        last = len(self._levels) - 1
        planned = 2 * last
        self._take(last, "inward", solution.q)
        paths = [("inward", last, solution.q)]
        for number, optimum in enumerate(solution.optima[1 : 1 + _PATHS]):
            price = self._price.measure(optimum.q)
            if price <= self._levels[last]:
                k = int(np.searchsorted(self._levels, price))
                paths.append((f"optimum {number}", k, optimum.q))
                self._take(k, paths[-1][0], optimum.q)
                planned += k - 1

        def step() -> None:
            if progress:
                progress(min(self.solves, planned), planned)

        for path, k, q in paths:
            for inner in range(k - 1, 0, -1):
                q = self._solve(inner, path, q)
                step()
        q = self._price.nearest
        for k in range(1, last + 1):
            q = self._solve(k, "outward", q)
            step()
        for _ in range(_ROUNDS):
            if not (self._try_neighbors(range(1, last + 1), -1) | self._try_neighbors(range(last - 1, 0, -1), +1)):
                break

    def _try_neighbors(self, order: range, neighbor: int) -> bool:
        """Solve again from better results for neighboring bounds; return whether a point of the curve improved."""
        better = False
        for k in order:
            best, other = self._best[k], self._best[k + neighbor]
            if other is None:
                continue
            rises = best is not None and neighbor < 0 and other.point.objective < best.point.objective
            if best is None or best.path != other.path or rises:
                self._solve(k, other.path, other.point.q)
                better |= self._best[k] is not best
        return better

    def _solve(self, k: int, path: str, start: Array) -> Array:
        """Solve with bound ``k`` from ``start``, or from a posture near ``start`` that satisfies the bound."""
        level = self._levels[k]
        key = (k, start.tobytes())
        if self._nlp is None or key in self._tried:
            return start
        self._tried.add(key)
        start = self._price.within(start, level)
        try:
            for _ in range(_GROWTH):
                nlp, warm = self._nlp.bounded(self._at(level)), self._ends.get(start.tobytes())
                first = nlp.solve(start, scale=self._scale, warm=warm)
                record, certificate = run_start(nlp, start, self._scale, first=first)
                self._ends[record.q.tobytes()] = record.end
                grown = self._problem.grown([record.q], auxiliaries=[record.auxiliaries])
                if grown is self._problem:
                    break
                self._problem, self._nlp = grown, self._nlp.grown(grown, compile=self._compile)
                start = record.q
            self._take(k, path, record.q, certificate)
        except MetricError:
            # The objective is not defined at the posture where the solver stopped, so the result is ignored.
            return start
        finally:
            self.solves += 1
        return record.q if certificate.holds() else start

    def _at(self, level: float) -> ConstrainedProblem:
        bound = self._price.bound(level)
        return replace(self._problem, constraints=(*self._problem.constraints[:-1], bound))

    def _take(self, k: int, path: str, q: Array, certificate: Certificate | None = None) -> None:
        """Keep the posture ``q`` if it satisfies the constraints and is the best so far under bound ``k``."""
        end, best = _End(path, self._point(k, q, certificate)), self._best[k]
        uncertified, objective = end.rank
        if end.point.certificate.feasible and (
            best is None or (uncertified, objective + _EQUAL * self._scale) < best.rank
        ):
            self._best[k] = end

    def _point(self, k: int, q: Array, certificate: Certificate | None = None) -> TradePoint:
        problem = self._at(self._levels[k])
        quantities = problem.impact.oracle.quantities(q)
        return TradePoint(
            within=self._levels[k],
            distance=self._price.measure(q),
            q=q,
            objective=problem.objective.value(q),
            H=quantities.H,
            G=quantities.G,
            V=quantities.V,
            S=quantities.S,
            certificate=certificate or certify(problem, q, self._scale),
            first=k == 0,
        )

    def finish(self, solution: PostureSolution, solve: float, build: float, notes: list[str]) -> TradeOff:
        points: list[TradePoint] = []
        for k, end in enumerate(self._best):
            # If no result satisfies the constraints, use the posture of the previous bound, which satisfies them.
            before = points[-1].q if points else self._price.nearest
            points.append(self._point(k, before) if end is None else end.point)
        best = solution.problem.objective.value(solution.q)
        open_bounds = [f"{p.within:.3g}" for p in points if not p.certified]
        if open_bounds:
            count = f"{len(open_bounds)} of {len(points)} points"
            notes.append(f"trade-off: {count} are not certified: within {', '.join(open_bounds)}")
        risen = [b for a, b in pairwise(points) if b.objective > a.objective + _RISE * self._scale]
        if risen:
            notes.append(
                f"trade-off: within {', '.join(f'{p.within:.3g}' for p in risen)} the posture is worse than "
                "within a smaller bound, so it is not the best posture there"
            )
        lowest = min(p.objective for p in points)
        if lowest < best - _RISE * self._scale and not solution.problem.requirements.regularization:
            notes.append(
                f"trade-off: the curve found a better posture ({lowest:.4g}) than the search ({best:.4g}); "
                "with more `starts`, the search may find it too"
            )
        knee = find_knee(np.array([p.distance for p in points]), np.array([p.objective for p in points]))
        return TradeOff(tuple(points), knee, self.solves, solve, build, tuple(notes), self._price.against)
