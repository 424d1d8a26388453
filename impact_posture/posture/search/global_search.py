"""Global search: the adaptive search, then a complete map if one or two degrees of freedom are left.

The map of the self-motion (:mod:`impact_posture.posture.manifold.self_motion`) bounds how far the objective can be
below the best objective.  With more degrees of freedom, the adaptive search
(:mod:`impact_posture.posture.search.screening`) already contains the basin hopping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from impact_posture.config.problem_settings import JOBS
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, SolverFailed
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.manifold.feasible_start import FEASIBLE
from impact_posture.posture.manifold.optimality_bound import OptimalityBound, bound_objective
from impact_posture.posture.manifold.self_motion import SelfMotion, map_self_motion
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian, rank
from impact_posture.posture.program.ipopt import one_blas_thread
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.system.arrays import Array

# An objective is better than another if it is lower by more than this fraction.
_BETTER = 1e-6
# A start missed the best posture if the objective at its end is more than this fraction above the best objective.
_MISSED = 1e-3
_KEYS = ("redundancy", "improvement", "missed_rate", "unseen_share", "estimated_optima", "hops", "word", "line")
# Attributes of a solution that describe the search before the manifold is mapped.
_OF_THE_STARTS = (
    "optima", "estimate", "starts", "feasible_starts", "certified_starts", "dominated_starts", "solve_time_s",
    "build_time_s",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SelfMotionMap:
    """Data for figures: the nodes of a mapped self-motion manifold.

    Attributes:
        q: Postures at the nodes, grouped by component, shape (N, nq); for one degree of freedom, in their order along
            the curve.
        component: Index of the component of each node, shape (N,).
        s: Path length along the component, rad mixed with m, shape (N,); zeros for two degrees of freedom.
        objective: Objective at each node, shape (N,).
        feasible: Whether each node satisfies the joint limits and inequalities, shape (N,).
        start, optimum: Index of the node nearest to the initial and to the best posture, shape (1,).
        ends: Index of the node nearest to each optimum of the preceding search, shape (M,).
    """

    q: Array
    component: NDArray[np.int_]
    s: Array
    objective: Array
    feasible: NDArray[np.bool_]
    start: NDArray[np.int_]
    optimum: NDArray[np.int_]
    ends: NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class GlobalSearch:
    """Result of the global search.

    Attributes:
        redundancy: Number of degrees of freedom that remain under the equality constraints.
        improvement: Relative decrease of the best objective by the map.
        missed_rate: Share of the certified starts whose final objective is more than 0.1 % above the best objective.
        unseen_share, estimated_optima, hops: As in the estimate of the solution
            (:class:`~impact_posture.posture.search.unseen_optima.SearchEstimate`).
        motion: The mapped self-motion manifold; ``None`` if more than two degrees of freedom are left.
        bound: Lower bound of the objective on the mapped manifold; ``None`` without a map.
        map: Data of the mapped manifold for figures; ``None`` without a map.
    """

    redundancy: int
    improvement: float
    missed_rate: float
    unseen_share: float
    estimated_optima: float
    hops: int
    motion: SelfMotion | None = None
    bound: OptimalityBound | None = None
    map: SelfMotionMap | None = None

    @property
    def line(self) -> str:
        """One sentence that describes the result."""
        missed = f"{100 * self.missed_rate:.0f} % of the starts"
        if self.motion is None or self.bound is None:
            return f"no map: {self.redundancy} degrees of freedom are left; {missed} missed the best posture"
        count = len(self.motion.components)
        pieces = "1 component" if count == 1 else f"{count} components"
        return (
            f"self-motion followed on {pieces}: no posture there is better by more than {100 * self.bound.gap:.2g} % "
            f"({self.word}); {missed} missed the best posture; the last {self.motion.unsuccessful} of "
            f"{self.motion.starts} random postures led to no new component"
        )

    @property
    def word(self) -> str | None:
        """``bounded`` if the manifold was mapped (the bound uses estimates and is not proved); otherwise ``None``."""
        return None if self.bound is None else "bounded"

    def to_dict(self) -> dict[str, object]:
        """Return the ``global`` block of ``result.json``."""
        block: dict[str, object] = {"method": "basin-hopping" if self.motion is None else "self-motion"}
        block |= {key: getattr(self, key) for key in _KEYS}
        if self.motion is not None and self.bound is not None and self.map is not None:
            block |= {key: getattr(self.bound, key) for key in ("lower", "gap", "patches", "finished")}
            block |= {key: getattr(self.motion, key) for key in ("starts", "unsuccessful")}
            block["components"] = [self._component(index) for index in range(len(self.motion.components))]
        return block

    def _component(self, index: int) -> dict[str, object]:
        assert self.motion is not None and self.map is not None  # noqa: S101 (narrows types)
        component, mine = self.motion.components[index], self.map.component == index
        values = self.map.objective[mine & self.map.feasible & np.isfinite(self.map.objective)]
        return {
            "length": float(component.s[-1]) if self.motion.dimension == 1 else None,
            "ends": list(component.ends),
            "feasible": float(self.map.feasible[mine].mean()),
            "objective": float(values.min()) if values.size else None,
        }


@dataclass(frozen=True, eq=False)
class GlobalSolution:
    """The best solution after the global search, with the result of the search."""

    solution: PostureSolution
    search: GlobalSearch


def check_searchable(problem: ConstrainedProblem) -> None:
    """Raise ``InputError`` unless the objective is an impact objective without a regularization."""
    _ = problem.impact
    if problem.requirements.regularization:
        fault = "can bound only the objective, but `regularization` adds the distance from the initial posture"
        hint = "leave out `regularization`, or use the search multistart"
        raise InputError(fault, where="search global", hint=hint)


@one_blas_thread()
def search_globally(
    solution: PostureSolution,
    *,
    seed: int = 0,
    jobs: int = JOBS,
    compile: CompileMode = "auto",
) -> GlobalSolution:
    """Map the self-motion after a search, and improve its solution; :func:`check_searchable` must accept the problem.

    ``seed`` is the seed of the random postures.
    """
    problem = solution.problem
    # The rank drops at a singular posture, so the larger rank of two postures gives the dimension of the manifold.
    numeric = Numeric(problem.robot.model)
    ranks = [rank(equality_jacobian(problem, numeric.at(q))) for q in (solution.initial, solution.q)]
    redundancy = problem.robot.nv - max(ranks)
    solve_from = partial(_improved, seed=seed, jobs=jobs, compile=compile)
    if redundancy not in (1, 2):
        return GlobalSolution(solution, GlobalSearch(redundancy, *_compared(solution, solution)))
    better, motion, bound, drawn = _mapped(solution, redundancy, seed, solve_from)
    return GlobalSolution(better, GlobalSearch(redundancy, *_compared(solution, better), motion, bound, drawn))


def _compared(before: PostureSolution, after: PostureSolution) -> tuple[float, float, float, float, int]:
    value, estimate = before.problem.objective.value, before.estimate
    best, starts = value(after.q), sum(optimum.hits for optimum in before.optima)
    near = sum(optimum.hits for optimum in before.optima if optimum.objective <= best * (1 + _MISSED))
    missed = 1 - near / max(starts, 1)
    return (
        max(0.0, 1 - best / value(before.q)), missed, estimate.unseen_share, estimate.estimated_optima, estimate.hops
    )  # fmt: skip


def _improved(
    before: PostureSolution, guesses: Sequence[Array], *, seed: int, jobs: int, compile: CompileMode
) -> PostureSolution:
    """Solve from ``guesses``; return this solution if it is better than ``before``, and otherwise ``before``."""
    try:
        count = 1 + len(guesses)
        after = solve(before.problem, starts=count, seed=seed, jobs=jobs, compile=compile, guesses=guesses)
    except SolverFailed:
        return before
    value = before.problem.objective.value
    if not value(after.q) < value(before.q) * (1 - _BETTER):
        return before
    return replace(after, **{key: getattr(before, key) for key in _OF_THE_STARTS})


def _mapped(
    solution: PostureSolution, redundancy: int, seed: int, solve_from: Callable[..., PostureSolution]
) -> tuple[PostureSolution, SelfMotion, OptimalityBound, SelfMotionMap]:
    """Map the manifold, solve from the best node of each component, and bound the objective on the map."""
    manifold = ConstraintManifold(solution.problem)
    chart, ends = manifold.chart, [optimum.q for optimum in solution.optima]
    known = np.array([chart.to_x(q) for q in (solution.initial, *ends)])
    motion = map_self_motion(manifold, redundancy, known, seed=seed)
    x = np.concatenate([part.x for part in motion.components])
    component = np.repeat(np.arange(len(motion.components)), [len(part.x) for part in motion.components])
    objective, feasible = manifold.objective(x)[0], manifold.distance_to_feasible(x) <= FEASIBLE
    usable = feasible & np.isfinite(objective)
    nodes_of = [np.flatnonzero(usable & (component == k)) for k in range(len(motion.components))]
    best_nodes = [nodes[objective[nodes].argmin()] for nodes in nodes_of if nodes.size]
    better = solve_from(solution, [manifold.to_q(x[node]) for node in best_nodes])
    bound = bound_objective(motion, solution.problem.objective.value(better.q))
    if bound.x is not None:
        better = solve_from(better, [manifold.to_q(bound.x)])
    points = manifold.embed(x)

    def nearest(*postures: Array) -> NDArray[np.int_]:
        targets = manifold.embed(np.array([chart.to_x(q) for q in postures]))
        return np.array([np.linalg.norm(points - target, axis=1).argmin() for target in targets])

    drawn = SelfMotionMap(
        q=np.array([manifold.to_q(node) for node in x]),
        component=component,
        s=np.concatenate([part.s for part in motion.components]),
        objective=objective,
        feasible=feasible,
        start=nearest(solution.initial),
        optimum=nearest(better.q),
        ends=nearest(*ends),
    )
    best = solution.problem.objective.value(better.q)
    return better, motion, replace(bound, best=best, lower=min(bound.lower, best)), drawn
