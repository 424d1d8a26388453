"""Warm starts: the solver starts from the result of a problem with another target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.impact_contact import point_on
from impact_posture.posture.formulation.build_problem import retarget
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.certificate import certify
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import PostureNLP, SolveRecord, build_nlp
from impact_posture.posture.search.multistart import solve

DOWN, AHEAD = (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)
CASES = {
    "tilthex_arm": {"normal": AHEAD},
    "panda": {"normal": DOWN},
    "ur5": {"normal": DOWN, "contact_pose": "position"},
    "anymal_kinova": {"normal": AHEAD},
    "talos": {"normal": AHEAD, "frame": "gripper_right_base_link"},
    "cone": {"robot": "tilthex_arm", "normal": DOWN, "normal_cone": 15.0},
}
Solved = tuple[PostureNLP, SolveRecord, float]


@pytest.fixture(
    scope="module",
    params=[pytest.param(c, marks=pytest.mark.long if c in ("anymal_kinova", "talos") else ()) for c in CASES],
)
def solved(request: pytest.FixtureRequest) -> Solved:
    """Return the program of a solved problem, with all rows that its optimum needs, and a run from this optimum."""
    settings = ProblemSettings(**{"robot": request.param, **CASES[request.param]})
    solution = solve(prepare(settings).problem, starts=2, jobs=1, finish_all=True)
    scale = solution.problem.objective.value(solution.q)
    nlp = build_nlp(solution.problem, compile="never")
    return nlp, nlp.solve(solution.q, scale=scale), scale


def moved(problem: ConstrainedProblem, step: float) -> ConstrainedProblem:
    """Return the problem with its target moved along y."""
    numeric = Numeric(problem.robot.model).at(problem.given)
    home = numeric.placement(point_on(problem.robot, problem.impact.contact.frame)).translation
    return retarget(problem, (home[0], home[1] + step, home[2]), None)


def test_it_ends_where_a_cold_run_does_with_fewer_iterations(solved: Solved) -> None:
    nlp, home, scale = solved
    there = nlp.at(moved(nlp.problem, 0.003))
    # The multipliers depend on the scale of the objective, but a warm start works for any scale.
    for factor in (1.0, 2.0):
        cold = there.solve(home.q, scale=factor * scale)
        warm = there.solve(home.q, scale=factor * scale, warm=home.end)
        assert cold.converged and warm.converged
        assert warm.iterations < 0.8 * cold.iterations
        # A cold run first moves away from the bounds, and may return to a neighboring, worse optimum.
        assert (1 - 1e-3) * cold.minimized < warm.minimized < (1 + 1e-6) * cold.minimized
        assert certify(there.problem, warm.q, factor * scale, warm.auxiliaries).holds()


def test_a_run_that_fails_begins_anew(solved: Solved) -> None:
    nlp, home, scale = solved
    there = nlp.at(moved(nlp.problem, 0.003))
    broken = replace(home.end, of_rows=np.full_like(home.end.of_rows, np.nan))
    cold, warm_run = (there.solve(home.q, scale=scale, warm=end) for end in (None, broken))
    assert warm_run.converged and warm_run.iterations >= cold.iterations
    np.testing.assert_array_equal(warm_run.q, cold.q)


def test_the_end_of_another_program_is_not_used(solved: Solved) -> None:
    nlp, home, scale = solved
    other = build_nlp(nlp.problem, compile="never", program=nlp.program)
    cold, warm_run = (other.solve(home.q, scale=scale, warm=end) for end in (None, home.end))
    assert (warm_run.iterations, warm_run.minimized) == (cold.iterations, cold.minimized)
    np.testing.assert_array_equal(warm_run.q, cold.q)


def test_one_start_and_a_guess_are_two_starts() -> None:
    problem = prepare(ProblemSettings(robot="tilthex_arm", normal=DOWN)).problem
    assert solve(problem, starts=1, jobs=1, compile="never", guesses=(problem.given,)).starts == 2
