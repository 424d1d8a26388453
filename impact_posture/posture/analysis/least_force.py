"""The posture with the least peak force, and the error message for a bound below this force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from impact_posture.config.problem_settings import JOBS
from impact_posture.errors import ImpactPostureError, Infeasible
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import Prepared
from impact_posture.posture.program.compiled_solver import CompileMode
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.system.arrays import Array


def least_effective_mass(
    problem: ConstrainedProblem,
    *,
    starts: int,
    seed: int = 0,
    jobs: int = JOBS,
    compile: CompileMode = "auto",
    guesses: Sequence[Array] = (),
) -> PostureSolution:
    """Minimize the effective mass, with friction, at the first contact under the constraints of a problem.

    For every contact stiffness, the posture with the least effective mass has the least peak force.  Arguments and
    errors are as in :func:`~impact_posture.posture.search.multistart.solve`.
    """
    mass = replace(problem.impact, kind="effective-mass", normal_cone_deg=0.0, others=(), model_variants=())
    lightest = replace(problem, objective=mass, requirements=replace(problem.requirements, regularization=0.0))
    return solve(lightest, starts=starts, seed=seed, jobs=jobs, compile=compile, guesses=guesses)


def explain_force_bound(
    error: Infeasible, prepared: Prepared, *, starts: int, seed: int, jobs: int, compile: CompileMode
) -> None:
    """Reword the error of an infeasible problem: state the least peak force that the other constraints allow.

    Leave the error as it is if the problem has no bound on the force, has model variants, or is infeasible without
    this bound.
    """
    problem, bound, contact = prepared.problem, prepared.settings.max_force, prepared.impact.contact_stiffness
    if bound is None or contact is None or problem.impact.model_variants:
        return
    unbounded = replace(problem.requirements, largest_mass=float("inf"))
    try:
        others = build_problem(problem.robot, problem.objective, problem.given, unbounded)
        least = least_effective_mass(others, starts=starts, seed=seed, jobs=jobs, compile=compile)
    except ImpactPostureError:
        return
    speed, count = prepared.impact.speed, f"{starts} start{'s' if starts > 1 else ''}"
    force = contact.peak_force(least.optima[0].objective, speed)
    reached = f"the least peak force that {count} reached under the other constraints is {force:.4g} N"
    if force > bound:
        hint = "permit more with `max_force`, lower the `speed`, or relax another constraint"
        error.reword(f"{bound:g} N cannot be kept: {reached}", "max_force", hint)
    else:
        error.reword(f"no start obeys {bound:g} N, although {reached}", "max_force", "start from another `posture`")
