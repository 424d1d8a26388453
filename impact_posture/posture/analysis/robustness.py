"""Robustness against model variants: how far the optimum moves, and how the objective changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from impact_posture.config.json_block import JsonBlock
from impact_posture.config.problem_settings import JOBS, STARTS
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible, SolverFailed
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.growing_search import Progress
from impact_posture.posture.search.impact_notes import percent
from impact_posture.posture.search.multistart import SAME_POSTURE, PostureSolution, solve, wrapped_difference
from impact_posture.robot.model_variant import between
from impact_posture.system.arrays import Array

# Number of random models between the variants, to check whether any model is worse than all variants.
_BETWEEN = 60
# Relative changes of the objective below this value are treated as errors of the solver.  Constraints with a
# violation below this value (m, rad) are treated as satisfied.
_NOISE = 1e-6


@dataclass(frozen=True, eq=False)
class VariantOptimum(JsonBlock):
    """A model variant and its own optimum, which is the best posture for this variant alone.

    ``at_robust`` is the objective of the variant at the robust optimum.  ``own_optimum`` is the objective of the
    variant at its own optimum ``own_q``, shape (nq,).  ``moved`` is the tangent distance between the robust optimum
    and ``own_q``.  ``own_optimum``, ``own_q`` and ``moved`` are ``None`` if no start ended at a certified posture.
    """

    name: str
    at_robust: float
    own_optimum: float | None
    own_q: Array | None
    moved: float | None


@dataclass(frozen=True, eq=False)
class Robustness:
    """Comparison of the robust optimum with the optimum of the nominal model (unchanged armature, no payload).

    Attributes:
        model_variants: All model variants; the nominal model is the first.
        worst_robust: Largest objective of any model variant at the robust optimum.
        worst_nominal: Largest objective of any model variant at the optimum of the nominal model; ``None`` if this
            optimum does not exist, or violates a constraint for another model variant.
        broken: Names of the constraints of the robust problem that the optimum of the nominal model violates.
        between: Largest objective at the robust optimum for the random models between the model variants.
    """

    model_variants: tuple[VariantOptimum, ...]
    worst_robust: float
    worst_nominal: float | None
    broken: tuple[str, ...]
    between: float
    drawn: int

    @property
    def moved(self) -> float | None:
        """Tangent distance of the robust optimum from the optimum of the nominal model."""
        return self.model_variants[0].moved

    @property
    def price(self) -> float | None:
        """Relative increase of the objective of the nominal model from the nominal optimum to the robust optimum."""
        own = self.model_variants[0].own_optimum
        return None if own is None else self.model_variants[0].at_robust / own - 1

    @property
    def gain(self) -> float | None:
        """Relative decrease of the largest objective of any variant, from the nominal to the robust optimum."""
        return None if self.worst_nominal is None else 1 - self.worst_robust / self.worst_nominal

    @property
    def line(self) -> str:
        """One sentence that describes the comparison."""
        if self.moved is None or self.price is None:
            return "the nominal model has no certified optimum to compare with"
        parts = [f"the optimum moves by {self.moved:.3g} rad (m)"]
        here = "at the optimum of the nominal model"
        if self.gain is None:
            parts.append(f"the optimum of the nominal model violates {', '.join(self.broken)}")
        elif self.gain < -_NOISE:
            parts.append(
                f"the worst case is {percent(-self.gain)} higher than {here}: more `starts` will find a better one"
            )
        else:
            parts.append(f"the worst case is {percent(max(self.gain, 0.0))} lower than {here}")
        side = "below" if self.price < -_NOISE else "above"
        parts.append(f"the objective of the nominal model is {percent(abs(self.price))} {side} its optimum")
        if self.between > self.worst_robust * (1 + _NOISE):
            parts.append(
                f"for models between the variants, the objective reaches {self.between:.4g}, above the worst variant"
            )
        return "; ".join(parts)

    def to_dict(self) -> dict[str, object]:
        """Return the ``robustness`` block of ``result.json``."""
        keys = ("moved", "price", "gain", "worst_robust", "worst_nominal", "line")
        return {key: getattr(self, key) for key in keys} | {
            "broken": list(self.broken),
            "between": {"drawn": self.drawn, "largest": self.between},
            "scenarios": [variant.to_dict() for variant in self.model_variants],
        }


@dataclass(frozen=True, eq=False)
class RobustSolution:
    """A solution and its robustness; the robustness is ``None`` if there are no model variants."""

    solution: PostureSolution
    robustness: Robustness | None


def solve_robustly(
    problem: ConstrainedProblem,
    *,
    starts: int = STARTS,
    seed: int = 0,
    jobs: int = JOBS,
    compile: CompileMode = "auto",
    progress: Progress | None = None,
    finish_all: bool = False,
    screened: int = 0,
) -> RobustSolution:
    """Solve the problem for each model variant alone, then for all; if there are no variants, solve it once.

    The search for the robust optimum starts from the optima of the variants and from ``starts`` other postures, or
    from the best of at most ``screened`` random postures.

    Raises:
        Infeasible, SolverFailed: See :func:`~impact_posture.posture.search.multistart.solve`.
    """
    given, wanted = problem.given, problem.requirements
    if not (isinstance(problem.objective, WorstCaseObjective) and problem.objective.model_variants):
        solution = solve(
            problem, starts=starts, seed=seed, jobs=jobs, compile=compile, progress=progress, finish_all=finish_all,
            screened=screened,
        )  # fmt: skip
        return RobustSolution(solution, None)
    # A problem is built for each variant, because support impulses and the center of mass depend on the model.
    alone = [
        build_problem(variant.robot, member, given, wanted)
        for variant, member in zip(problem.impact.model_variants, problem.impact.by_variant, strict=True)
    ]
    total = starts * (len(alone) + 1)

    def run(posed: ConstrainedProblem, guesses: Sequence[Array], number: int) -> PostureSolution:
        def advance(done: int, _: int) -> None:
            if progress is not None:
                progress(min(number * starts + done, total), total)

        count = starts + len(guesses)
        return solve(
            posed, starts=count, seed=seed, jobs=jobs, compile=compile, progress=advance, guesses=guesses,
            finish_all=finish_all, screened=screened,
        )  # fmt: skip

    optima = [_optimum(partial(run, member, (), k)) for k, member in enumerate(alone)]
    feasible = [q for q in optima if q is not None and not _broken(problem, q)]
    solution = run(problem, _apart(problem, feasible), len(alone))
    for k, (member, q) in enumerate(zip(alone, optima, strict=True)):
        # If the robust optimum is better for a variant than the variant's own optimum, the search for that variant
        # missed a better posture.  Repeat the search for this variant, also from the robust optimum.
        if q is None or member.objective.value(solution.q) < member.objective.value(q) * (1 - _NOISE):
            optima[k] = _optimum(partial(run, member, (solution.q,), len(alone)))
    return RobustSolution(solution, compare_variants(solution, optima, seed))


def compare_variants(solution: PostureSolution, optima: Sequence[Array | None], seed: int = 0) -> Robustness:
    """Compare the robust optimum with the optima of the variants, and evaluate random models between the variants."""
    problem, objective = solution.problem, solution.problem.impact
    variants: list[VariantOptimum] = []
    for variant, q in zip(objective.model_variants, optima, strict=True):
        member = replace(objective, robot=variant.robot, model_variants=())
        own = None if q is None else member.value(q)
        step = None if q is None else float(np.linalg.norm(wrapped_difference(problem, solution.q, q)))
        variants.append(VariantOptimum(variant.name, member.value(solution.q), own, q, step))
    nominal = optima[0]
    broken = () if nominal is None else tuple(_broken(problem, nominal))
    drawn = between(objective.model_variants, _BETWEEN, seed)
    values = [replace(objective, robot=robot, model_variants=()).value(solution.q) for robot in drawn]
    return Robustness(
        model_variants=tuple(variants),
        worst_robust=objective.value(solution.q),
        worst_nominal=None if nominal is None or broken else objective.value(nominal),
        broken=broken,
        between=max(values),
        drawn=len(values),
    )


def _apart(problem: ConstrainedProblem, postures: Sequence[Array]) -> list[Array]:
    """Return the postures, leaving out each posture that nearly equals an earlier one."""
    kept: list[Array] = []
    for q in postures:
        if all(np.linalg.norm(wrapped_difference(problem, other, q)) > SAME_POSTURE for other in kept):
            kept.append(q)
    return kept


def _broken(problem: ConstrainedProblem, q: Array) -> list[str]:
    violations = problem.violations(Numeric(problem.robot.model).at(q))
    pairs = zip(problem.constraints, violations, strict=True)
    return [constraint.name for constraint, excess in pairs if np.abs(excess).max(initial=0.0) > _NOISE]


def _optimum(run: Callable[[], PostureSolution]) -> Array | None:
    try:
        return run().q
    except (Infeasible, SolverFailed):
        return None
