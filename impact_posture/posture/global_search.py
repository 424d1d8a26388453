"""The search beyond multi-start: a complete map for one or two degrees of freedom, basin hopping for all others.

The map (:mod:`impact_posture.posture.self_motion`) states how far the best posture can be from optimal.  Basin
hopping starts again from the best posture with some joints drawn anew (D. J. Wales and J. P. K. Doye, "Global
optimization by basin-hopping", J. Phys. Chem. A 1997), because many optima differ in a few joints only.  The value at
a start says little about the optimum that it leads to, so starts are not chosen by value (``make study-global``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from impact_posture.arrays import Array
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, MetricError
from impact_posture.posture.certificate import Certificate
from impact_posture.posture.compiled import CompileMode
from impact_posture.posture.constraint_manifold import ConstraintManifold
from impact_posture.posture.missed_optima import estimated_optima, unseen_share
from impact_posture.posture.nlp import PostureNLP, SolveRecord, build_nlp, one_blas_thread
from impact_posture.posture.optimality_bound import OptimalityBound, bound_objective
from impact_posture.posture.problem import PostureProblem, equality_jacobian, rank
from impact_posture.posture.self_motion import SelfMotion, map_self_motion
from impact_posture.posture.solve import PostureSolution, Progress, run_start
from impact_posture.posture.starts import Projector, random_posture
from impact_posture.processes import fork_map

# Hops for each start of the multi-start search, and hops that leave from the same posture, side by side.
HOPS_PER_START, _ROUND = 3, 4
# Shares of the joints that a hop draws anew.
_REDRAWN = (0.1, 0.25, 0.5)
# A value is better if it is lower by more than this share.
_BETTER = 1e-6
# A start missed the best posture if it ended more than this share above.
_MISSED = 1e-3
_KEYS = ("redundancy", "improvement", "missed_rate", "unseen_share", "estimated_optima", "hops", "word", "line")
# Largest violation of a start on the constraints.
_ON = 1e-8


@dataclass(frozen=True, eq=False)
class SelfMotionMap:
    """The nodes of a mapped self-motion manifold, to be drawn.

    Attributes:
        q: Nodes, component after component, along the curve for one degree of freedom, shape (N, nq).
        component: Index of the component of each node, shape (N,).
        s: Path length along the component, rad mixed with m, shape (N,); zeros for two degrees of freedom.
        objective: The objective, shape (N,).
        feasible: Whether limits and inequalities hold, shape (N,).
        start: Index of the node nearest to the initial posture, shape (1,).
        optimum: Index of the node nearest to the best posture, shape (1,).
        ends: Index of the node nearest to each optimum of the multi-start search, shape (M,).
    """

    q: Array
    component: Array
    s: Array
    objective: Array
    feasible: Array
    start: Array
    optimum: Array
    ends: Array


@dataclass(frozen=True, eq=False)
class GlobalSearch:
    """Finding of the search beyond multi-start.

    Attributes:
        redundancy: Degrees of freedom that the equalities leave.
        improvement: Share by which the best posture is below the best one of the multi-start search.
        missed_rate: Share of the certified starts that ended more than 0.1 % above the best posture.
        unseen_share: Estimated share of further starts that would end in an optimum not seen yet.
        estimated_optima: Estimated number of optima.
        hops: Hops of basin hopping; 0 with a map.
        motion: The map, or ``None``.
        bound: The bound on the map, or ``None``.
        map: The map as drawn, or ``None``.
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
        """The finding in words."""
        missed = f"{100 * self.missed_rate:.0f} % of the starts"
        if self.motion is None or self.bound is None:
            return (
                f"{self.hops} hops from the best posture lower the objective by {100 * self.improvement:.2g} %; "
                f"{missed} missed it, about {100 * self.unseen_share:.0f} % of further starts would find an "
                f"optimum not seen yet, of about {self.estimated_optima:.0f}"
            )
        count = len(self.motion.components)
        pieces = "1 component" if count == 1 else f"{count} components"
        return (
            f"self-motion followed on {pieces}: at most {100 * self.bound.gap:.2g} % above the best posture on them "
            f"({self.word}); {missed} missed it; the last {self.motion.unsuccessful} of {self.motion.starts} random "
            "postures found no new component"
        )

    @property
    def word(self) -> str | None:
        """How far the bound can be trusted: ``bounded``, because it rests on estimates; ``None`` without a map."""
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
    """The better one of a given solution and the postures found beyond it, with the finding."""

    solution: PostureSolution
    search: GlobalSearch


def check_searchable(problem: PostureProblem) -> None:
    """Refuse a problem that :func:`search_globally` cannot search.

    Raises:
        InputError: The objective is not that of an impact, or the distance from the start counts, too.
    """
    _ = problem.impact
    if problem.requirements.regularization:
        raise InputError(
            "bounds the objective alone, but `regularization` adds the distance from the start",
            where="search global",
            hint="leave `regularization` away, or use the search multistart",
        )


@one_blas_thread()
def search_globally(
    solution: PostureSolution,
    *,
    seed: int = 0,
    jobs: int = 2,
    compile: CompileMode = "auto",
    progress: Progress | None = None,
) -> GlobalSolution:
    """Search on from the solution of the multi-start search.

    Args:
        solution: The solution of a problem that passes :func:`check_searchable`.
        seed: Seed of the random postures.
        jobs: Processes that search side by side.
        compile: Whether the program is compiled.
        progress: Called with the solves done and planned.
    """
    problem = solution.problem
    # A singular posture has more freedom than the manifold.
    redundancy = min(_redundancy(problem, q) for q in (solution.initial, solution.q))
    hops = HOPS_PER_START * solution.starts
    nlp = build_nlp(problem, compile=compile, starts=hops)
    if redundancy in (1, 2):
        better, motion, bound = _mapped(solution, redundancy, nlp, seed, jobs)
        drawn = _drawn(motion, solution, better)
        return GlobalSolution(better, GlobalSearch(*_compared(solution, better), 0, motion, bound, drawn))
    better = _hop(solution, nlp, hops, seed, jobs, progress)
    return GlobalSolution(better, GlobalSearch(*_compared(solution, better), hops))


def _compared(before: PostureSolution, after: PostureSolution) -> tuple[int, float, float, float, float]:
    """Return the first five attributes of :class:`GlobalSearch`."""
    value, hits = before.problem.objective.value, [optimum.hits for optimum in before.optima]
    best = value(after.q)
    near = sum(optimum.hits for optimum in before.optima if optimum.objective <= best * (1 + _MISSED))
    improvement = max(0.0, 1 - best / value(before.q))
    return after.redundancy, improvement, 1 - near / sum(hits), unseen_share(hits), estimated_optima(hits)


def _ends(solution: PostureSolution) -> list[Array]:
    return [optimum.q for optimum in solution.optima]


# ---- one or two degrees of freedom ---------------------------------------------------------------------------


def _mapped(
    solution: PostureSolution, redundancy: int, nlp: PostureNLP, seed: int, jobs: int
) -> tuple[PostureSolution, SelfMotion, OptimalityBound]:
    """Map the manifold, polish the best node of each component, and bound what is left."""
    manifold = ConstraintManifold(solution.problem)
    known = np.array([manifold.chart.to_x(q) for q in (solution.initial, *_ends(solution))])
    motion = map_self_motion(manifold, redundancy, known, seed=seed)
    guesses = []
    for component in motion.components:
        feasible = manifold.distance_to_feasible(component.x) <= _ON
        values = np.where(feasible, manifold.objective(component.x)[0], np.inf)
        if np.isfinite(values).any():
            guesses.append(manifold.to_q(component.x[int(np.nanargmin(values))]))
    better = _better(solution, _solved(nlp, solution, guesses, jobs))
    bound = bound_objective(motion, solution.problem.objective.value(better.q))
    if bound.x is not None:
        better = _better(better, _solved(nlp, solution, [manifold.to_q(bound.x)], jobs))
        bound = replace(bound, best=min(bound.best, solution.problem.objective.value(better.q)))
    return better, motion, bound


def _drawn(motion: SelfMotion, before: PostureSolution, after: PostureSolution) -> SelfMotionMap:
    from scipy.spatial import cKDTree

    manifold, parts = motion.manifold, motion.components
    x = np.concatenate([part.x for part in parts])
    tree = cKDTree(manifold.embed(x))

    def nearest(postures: Sequence[Array]) -> Array:
        return np.asarray(tree.query(manifold.embed(np.array([manifold.chart.to_x(q) for q in postures])))[1])

    return SelfMotionMap(
        q=np.array([manifold.to_q(one) for one in x]),
        component=np.repeat(np.arange(len(parts)), [len(part.x) for part in parts]),
        s=np.concatenate([part.s for part in parts]),
        objective=manifold.objective(x)[0],
        feasible=manifold.distance_to_feasible(x) <= 1e-6,
        start=nearest([before.initial]),
        optimum=nearest([after.q]),
        ends=nearest(_ends(before)),
    )


# ---- more degrees of freedom ---------------------------------------------------------------------------------


def _hop(
    solution: PostureSolution, nlp: PostureNLP, hops: int, seed: int, jobs: int, progress: Progress | None
) -> PostureSolution:
    """Draw some joints of the best posture anew, solve, and keep the result if it is better."""
    projector, rng = Projector(solution.problem), np.random.default_rng([seed, 1])
    for done in range(0, hops, _ROUND):
        drawn = [_redrawn(projector, solution.q, rng) for _ in range(min(_ROUND, hops - done))]
        found = _solved(nlp, solution, [q for q in drawn if q is not None], jobs)
        solution = _better(solution, found)
        if progress is not None:
            progress(done + len(drawn), hops)
    return solution


def _redrawn(projector: Projector, q: Array, rng: np.random.Generator) -> Array | None:
    """Return the posture with some joints drawn anew, pulled onto the constraints; ``None`` if it does not reach."""
    chart = projector.chart
    x, other = chart.to_x(q), chart.to_x(random_posture(projector.problem, chart, rng, near=False))
    share = rng.choice(_REDRAWN)
    for slot in chart.slots:
        if slot.kind.family != "free-flyer" and rng.random() < share:
            x[slot.x] = other[slot.x]
    found = projector.project(chart.to_q(x))
    return found.q if found.violation <= _ON else None


# ---- solves --------------------------------------------------------------------------------------------------

_Solved = tuple[float, SolveRecord, Certificate]


def _solved(nlp: PostureNLP, solution: PostureSolution, starts: Sequence[Array], jobs: int) -> list[_Solved]:
    """Return objective, record and certificate of the starts that end at a certified posture, in their order."""
    scale = nlp.problem.objective.value(solution.initial)
    with fork_map(partial(_run, nlp, starts, scale), len(starts), jobs if len(starts) > 3 else 1) as results:
        found = dict(results)
    return [found[index] for index in range(len(starts)) if found[index][2].holds()]


def _run(nlp: PostureNLP, starts: Sequence[Array], scale: float, index: int) -> _Solved:
    record, certificate = run_start(nlp, starts[index], scale)
    try:
        return nlp.problem.objective.value(record.q), record, certificate
    except MetricError:
        return np.inf, record, certificate


def _better(solution: PostureSolution, found: Sequence[_Solved]) -> PostureSolution:
    """Return the solution at the best posture of all."""
    if not found:
        return solution
    problem = solution.problem
    objective, record, certificate = min(found, key=lambda one: one[0])
    if not objective < problem.objective.value(solution.q) * (1 - _BETTER):
        return solution
    return replace(
        solution, q=record.q, certificate=certificate, status=record.status, iterations=record.iterations,
        redundancy=_redundancy(problem, record.q),
    )  # fmt: skip


def _redundancy(problem: PostureProblem, q: Array) -> int:
    numeric = Numeric(problem.robot.model)
    return problem.robot.nv - rank(equality_jacobian(problem, numeric.at(q)))
