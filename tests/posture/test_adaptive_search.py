"""The adaptive search: functions of a batch, descents, screening, and the sentence about unseen optima."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from docs.studies.cases import CASES
from docs.studies.search_quality import random_arm
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.manifold import batch_function
from impact_posture.posture.manifold.batch_descent import BatchDescent, Ends
from impact_posture.posture.manifold.batch_function import BatchFunction
from impact_posture.posture.manifold.constraint_manifold import ConstraintManifold
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search import screening as screening_module
from impact_posture.posture.search.growing_search import run_start
from impact_posture.posture.search.multistart import PostureSolution, _estimate, solve
from impact_posture.posture.search.screening import Screening, screen, screenable
from impact_posture.posture.search.unseen_optima import SAME_VALUE, SearchEstimate, hits_by_value
from impact_posture.system import toolchain
from tests.posture.test_self_motion import drawn
from tests.support.command import succeed
from tests.support.settings import make_settings
from tests.support.tools import need_compiler


def descended(manifold: ConstraintManifold, x: np.ndarray) -> Ends:
    descent = BatchDescent(manifold)
    descent.add(x, np.arange(len(x)))
    ends = Ends(np.zeros((0, x.shape[1])), np.zeros(0), np.zeros(0, dtype=int))
    while descent.active:
        ends = ends.joined(descent.step())
    return ends


# ---- functions of a batch --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["tilthex_arm, cone 20°", "solo8, four feet, cone 20°", "solo12, two feet struck", "tilthex_arm, 6 models"],
)
def test_a_batch_equals_single_calls(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    manifold = ConstraintManifold(CASES[name].problem())
    # Two full batches, and a third batch with one posture.
    x = drawn(manifold, 2 * batch_function._WIDTH + 1, 0)
    for loop in (batch_function._compiled_loop(), None):
        monkeypatch.setattr(batch_function, "_compiled_loop", lambda loop=loop: loop)
        for function in (manifold._objective, manifold._equalities):
            assert function._operations is not None
            for together, alone in zip(function(x), function._one_by_one((x,)), strict=True):
                scale = np.nanmax(np.abs(alone), initial=1.0)
                np.testing.assert_allclose(together, alone, rtol=1e-9, atol=1e-12 * scale)


def test_operations_in_c_equal_the_operations_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    need_compiler()
    assert batch_function._compiled_loop() is not None
    x, codes = ca.SX.sym("x", 2), [*batch_function._OPERATIONS]
    results = [
        ca.SX.binary(code, x[0], x[1]) if "b" in re.findall(r"\w+", formula) else ca.SX.unary(code, x[0])
        for code, (_, formula) in batch_function._OPERATIONS.items()
    ]
    function = BatchFunction([x], [ca.vertcat(*results)])
    assert {*codes} - {code for code, *_ in function._operations or ()} <= {ca.OP_ASSIGN, ca.OP_CONSTPOW}
    special = [-np.inf, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, np.inf, np.nan]
    values = np.concatenate([np.random.default_rng(0).normal(size=(100, 2)), [*product(special, special)]])
    in_c = function(values)[0]
    monkeypatch.setattr(batch_function, "_compiled_loop", lambda: None)
    for k, by_numpy in enumerate(function(values)[0].swapaxes(0, 1)):
        np.testing.assert_allclose(in_c[:, k], by_numpy, rtol=1e-14, err_msg=results[k].str())


def test_without_a_compiler_numpy_evaluates_batches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path))
    monkeypatch.setattr(batch_function, "_compiled_loop", batch_function._compiled_loop.__wrapped__)
    assert batch_function._compiled_loop() is not None
    monkeypatch.setattr(toolchain, "find_compiler", lambda: None)
    # The cached library needs no compiler.
    assert batch_function._compiled_loop() is not None
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "empty"))
    assert batch_function._compiled_loop() is None
    x = ca.SX.sym("x")
    values = np.linspace(-1, 1, 80)[:, None]
    np.testing.assert_array_equal(BatchFunction([x], [x * x])(values)[0][:, :, 0], values**2)


def test_a_batch_of_a_function_that_numpy_lacks_is_still_right() -> None:
    x = ca.SX.sym("x", 2)
    function = BatchFunction([x], [ca.vertcat(ca.erf(x[0]), ca.if_else(x[1] > 0, ca.sqrt(x[1]), 3))])
    values = np.random.default_rng(0).normal(size=(100, 2))
    assert function._operations is None
    assert function(values)[0].shape == (100, 2, 1)
    np.testing.assert_allclose(function(values)[0][:, 1, 0], np.where(values[:, 1] > 0, values[:, 1], 9.0) ** 0.5)


def test_a_branch_that_is_not_taken_may_be_undefined() -> None:
    x = ca.SX.sym("x")
    values = np.linspace(-1, 1, 80)[:, None]
    root = BatchFunction([x], [ca.if_else(x > 0, ca.sqrt(x), 0)])(values)[0][:, 0, 0]
    np.testing.assert_allclose(root, np.sqrt(np.maximum(values[:, 0], 0)))


# ---- descents --------------------------------------------------------------------------------------------------


def test_the_merit_has_the_gradient_of_finite_differences() -> None:
    problem = prepare(make_settings({"robot": "solo12", "normal": (1, 0, 0), "com": True})).problem
    manifold, size = ConstraintManifold(problem), 1e-6
    x = drawn(manifold, 4, 0)
    gradient = manifold.evaluate(x).gradient
    for k in range(manifold.chart.nv):
        step = np.zeros((4, manifold.chart.nv))
        step[:, k] = size
        ahead, behind = (manifold.evaluate(manifold.move(x, sign * step)).merit for sign in (1, -1))
        np.testing.assert_allclose(gradient[:, k], (ahead - behind) / (2 * size), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("number", [0, 5])
def test_descents_end_near_optima_on_the_constraints(number: int) -> None:
    problem = random_arm(number)
    manifold = ConstraintManifold(problem)
    x = manifold.project(drawn(manifold, 80, 0), within=True)
    before = x.x[x.converged]
    ends = descended(manifold, before)
    assert len(ends.x) >= len(before) / 2
    assert np.abs(manifold.equalities(ends.x)[0]).max() < 1e-4
    assert (ends.x >= problem.lower - 1e-12).all() and (ends.x <= problem.upper + 1e-12).all()
    assert (ends.merit <= manifold.evaluate(before).merit[ends.tag] + 1e-9).all()
    assert np.median(manifold.evaluate(before).merit) - np.median(ends.merit) > 0.5
    # From most ends, a second descent cannot lower the merit by 1 %.  Near the best end is a certified optimum.
    again = descended(manifold, ends.x)
    assert np.mean(ends.merit[again.tag] - again.merit < 0.01) > 0.8
    nlp, best = build_nlp(problem, compile="never"), ends.merit.argmin()
    record, certificate = run_start(nlp, manifold.to_q(ends.x[best]), problem.objective.value(problem.given))
    assert certificate.holds()
    assert np.log(problem.objective.value(record.q)) == pytest.approx(ends.merit[best], abs=0.01)


def test_a_joint_that_is_held_does_not_move() -> None:
    problem = prepare(
        make_settings({"robot": "panda", "normal": (0, 0, 1), "contact_pose": "position", "hold": ("panda_joint2",)})
    ).problem
    manifold = ConstraintManifold(problem)
    column = problem.robot.model.idx_vs[problem.robot.joint_id("panda_joint2")]
    x = drawn(manifold, 70, 0)
    start = manifold.chart.to_x(problem.given)[column]
    x[:, column] = start
    ends = descended(manifold, x)
    assert len(ends.x) and np.abs(ends.x[:, column] - start).max() < 1e-9
    assert np.ptp(ends.x, axis=0).max() > 0.1


# ---- the search ------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_adaptive_search_reaches_what_sixteen_starts_miss() -> None:
    problem = random_arm(5)
    many = solve(problem, starts=200, seed=9, jobs=1, compile="never").optima[0].objective
    few = solve(problem, jobs=1, compile="never")
    adaptive = solve(problem, screened=1024, jobs=1, compile="never")
    assert few.optima[0].objective > 1.1 * many
    assert adaptive.optima[0].objective <= many * (1 + 1e-6) and adaptive.certificate.holds()
    assert adaptive.estimate.method == "adaptive" and adaptive.estimate.hits_of_best >= 3
    # The search stopped long before its limit.
    assert adaptive.estimate.starts + adaptive.estimate.hops < 700


def test_hops_reach_what_random_postures_miss(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = random_arm(22)
    hops = solve(problem, screened=1024, seed=1, jobs=1, compile="never")
    monkeypatch.setattr(screening_module, "_HOPPING", 0.0)
    random = solve(problem, screened=1024, seed=1, jobs=1, compile="never")
    assert hops.estimate.hops > 300 and random.estimate.hops == 0
    assert hops.optima[0].objective < 0.8 * random.optima[0].objective


def test_one_seed_gives_one_answer() -> None:
    problem = random_arm(2)
    first, again = (solve(problem, screened=200, seed=3, jobs=jobs, compile="never") for jobs in (1, 2))
    np.testing.assert_array_equal(first.q, again.q)
    assert first.estimate == again.estimate
    other = solve(problem, screened=200, seed=4, jobs=1, compile="never")
    assert other.estimate != first.estimate


@pytest.mark.parametrize("most", [1, 40])
def test_the_number_of_starts_limits_the_screening(most: int) -> None:
    problem = random_arm(2)
    screening = screen(problem, problem.given, most, 0)
    assert sum(screening.hits) <= sum(screening.values) <= most - screening.hops
    solution = solve(problem, screened=most, jobs=1, compile="never")
    assert solution.certificate.holds() and solution.starts == 1 + len(screening.guesses)


def test_a_problem_that_cannot_be_screened_uses_random_starts() -> None:
    problem = random_arm(0)
    near = replace(problem, requirements=replace(problem.requirements, regularization=1.0))
    assert screenable(problem) and not screenable(near)
    solution = solve(near, starts=3, screened=500, jobs=1, compile="never")
    assert solution.estimate.method == "multistart" and solution.starts == 3


@pytest.mark.long(but=("go2-normal0",))
@pytest.mark.parametrize("robot, normal", [("go2", (-1, 0, 0)), ("hextilt", (0, 0, 1))])
def test_collisions_and_loads_stay_excluded(robot: str, normal: tuple[float, float, float]) -> None:
    problem = prepare(make_settings({"robot": robot, "normal": normal, "collision": True, "holdable": True})).problem
    solution: PostureSolution = solve(problem, screened=128, jobs=1, compile="never")
    assert solution.certificate.holds()
    # The first random postures leave descents for hops.
    assert solution.estimate.hops > 30
    assert problem.surroundings is not None and not problem.surroundings.collisions(solution.q)
    initial = problem.objective.value(solution.initial)
    assert problem.objective.value(solution.q) <= initial * (1 + 1e-9)


def test_feasible_starts_descend_where_few_random_postures_reach_the_equalities() -> None:
    # The best objective of 128 starts is 2.904.  One random posture in a thousand leads to this objective, but four
    # of a hundred feasible starts do.
    problem = prepare(
        make_settings({"robot": "solo8", "normal": (0, 0, 1), "collision": True, "holdable": True})
    ).problem
    solution = solve(problem, seed=1, screened=6144, jobs=1, compile="never")
    assert solution.optima[0].objective == pytest.approx(2.9041, rel=1e-3)


# ---- the estimate ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "hits, line",
    [
        ([4, 1, 15], "20 starts reached optima with 3 different objectives, the best hit 4 times; about 5.0 %"),
        ([20], "20 starts reached optima with one objective, the best hit 20 times; fewer than 15 %"),
        ([1], "1 start reached optima with one objective, the best hit once; about 100 %"),
    ],
)
def test_the_line_of_an_estimate(hits: list[int], line: str) -> None:
    end = " of further starts would lead to another objective"
    assert SearchEstimate.of("multistart", hits).line == line + end
    bound = SearchEstimate.of("multistart", hits, bound=True, partial=True).line
    early = line.replace("about", "at most about").replace("reached optima with", "ended at")
    assert bound == early + end + " if these starts ignore clearances and loads"


def test_given_postures_are_named_beside_the_starts() -> None:
    line = SearchEstimate.of("adaptive", [2, 1, 1, 1], hops=3, bound=True, given=1).line
    assert line.startswith(
        "4 starts, 3 hops and the given posture ended at 4 different objectives, the best hit 2 times; at most about "
    )


def test_hits_of_guesses_that_one_optimum_attracts_are_added() -> None:
    """Starts of the first and second group end at the same objective, and nothing solves the third group."""
    # Two starts of the first group ended at other postures.  If they ignored clearances, their optimum is unknown.
    for partial, optima, best in ((False, 3, 1 + 3 + 2 + 2), (True, 4, 1 + 3 + 2)):
        screening = Screening((np.zeros(2),) * 3, (3, 4, 2), (0, 0, 1), (9, 2, 1), partial, hops=0)
        estimate = _estimate([1.0, 1.0, 2.0, 1.001], 0, screening)
        assert (estimate.optima, estimate.hits_of_best) == (optima, best)
        assert (estimate.starts, estimate.given) == (12, 1)
        assert estimate.unseen_share == pytest.approx(1 / 13)
    several = _estimate([0.5, None, 0.5 + 1e-9, 0.6, 0.5], 1, None)
    assert (several.optima, several.hits_of_best, several.starts) == (3, 3, 5)
    assert several.line.startswith("5 starts ended at 3 different objectives, the best hit 3 times")


@pytest.mark.parametrize("starts", [4, 40])
def test_the_numbers_of_a_search_agree(starts: int) -> None:
    estimate = solve(random_arm(3), screened=starts, jobs=1, compile="never").estimate
    # Hops may end at objectives where no start ends.
    assert estimate.hits_of_best + estimate.optima - 1 <= estimate.starts + estimate.hops + estimate.given
    assert estimate.given == 1 and estimate.starts + estimate.hops <= starts


def test_values_that_are_nearly_equal_are_one() -> None:
    assert hits_by_value([0.3, 0.1, 0.102, 0.2, 0.104], [1, 2, 3, 4, 5]) == (10, 4, 1)
    assert hits_by_value([], []) == ()


@pytest.mark.long(but=("5",))
@pytest.mark.parametrize("number", [2, 5])
def test_the_share_bounds_independent_starts(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """IPOPT from 100 random postures reaches objectives that no descent reached, at most as often as estimated."""
    problem, merits = random_arm(number), list[np.ndarray]()

    def kept(values: np.ndarray, hits: np.ndarray) -> tuple[int, ...]:
        merits.append(values)
        return hits_by_value(values, hits)

    monkeypatch.setattr(screening_module, "hits_by_value", kept)
    share = SearchEstimate.of("adaptive", screen(problem, problem.given, 1024, 0).values).unseen_share
    others = solve(problem, starts=100, seed=9, jobs=1, compile="never", finish_all=True).optima
    new = [o.hits for o in others if np.abs(merits[0] - np.log(o.objective)).min() > SAME_VALUE]
    # Three standard deviations of the share of 100 starts, which is at least 2 % here.
    assert sum(new) / 100 <= share + 3 * np.sqrt(max(share * (1 - share), 0.02) / 100)


def test_an_optimum_of_hops_has_no_hits() -> None:
    estimate = SearchEstimate.of("adaptive", [0, 3, 2], hops=9)
    assert estimate.line.startswith(
        "5 starts and 9 hops reached optima with 3 different objectives, the best reached by hops only; fewer than 60"
    )


def test_every_answer_states_the_estimate(tmp_path: Path) -> None:
    options = ("--normal", 0, 0, 1, "--jobs", 1, "--no-codegen", "--no-report", "--format", "png")
    for name, more in (("adaptive", ("--starts", 40)), ("multistart", ("--search", "multistart", "--starts", 3))):
        done = succeed("optimize", "tilthex_arm", *options, *more, "--out", name, cwd=tmp_path)
        block = json.loads((tmp_path / name / "result.json").read_text())["search"]
        assert block["method"] == name and block["starts"] <= 40
        assert block["line"] in " ".join(done.stdout.split())


def test_full_turns_do_not_leave_the_limits() -> None:
    problem = prepare(make_settings({"robot": "ur5", "normal": (0, 0, 1)})).problem
    manifold = ConstraintManifold(problem)
    ends = descended(manifold, drawn(manifold, 70, 0))
    model = problem.robot.model
    for posture in ends.x:
        q = manifold.to_q(posture)
        assert (q >= model.lowerPositionLimit - 1e-9).all() and (q <= model.upperPositionLimit + 1e-9).all()
        assert pin.isNormalized(model, q)
