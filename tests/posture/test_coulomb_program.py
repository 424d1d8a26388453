"""Friction in the optimization program, the C export and the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from impact_posture.codegen.export import export
from impact_posture.codegen.self_test import sample_postures
from impact_posture.impact.friction.coulomb_impact import coulomb_impact
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import prepare, read_settings
from impact_posture.posture.manifold.feasible_start import feasible_start
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import build_nlp
from impact_posture.posture.search.growing_search import run_start
from impact_posture.posture.search.multistart import solve
from tests.support.arms import TIP, Y, arm
from tests.support.command import refused, run
from tests.support.exported import built
from tests.support.helpers import assert_close
from tests.support.settings import make_settings
from tests.support.tools import need_compiler


def problem_of(robot: str, normal: tuple[float, float, float], friction: float, **more: object) -> ConstrainedProblem:
    values = {"robot": robot, "normal": normal, "friction": friction, "objective": "coulomb", **more}
    return prepare(make_settings(values)).problem


@pytest.mark.parametrize(
    ("robot", "normal", "frictions", "more"),
    (
        ("tilthex_arm", (-1.0, 0.0, 0.0), (0.3, 0.8), {}),
        ("panda", (0.0, 0.6, 0.8), (0.1, 0.5), {"contact_pose": "position", "metric": "kinetic"}),
        ("solo12", (1.0, 0.0, 0.0), (0.3,), {}),
    ),
)
def test_solutions_are_certified(
    robot: str, normal: tuple[float, float, float], frictions: tuple[float, ...], more: dict[str, object]
) -> None:
    for friction in frictions:
        problem = problem_of(robot, normal, friction, **more)
        solution = solve(problem, starts=3, jobs=1, compile="never")
        assert solution.certificate.holds()
        assert problem.objective.value(solution.q) <= problem.objective.value(solution.initial) * (1 + 1e-9)


@pytest.mark.parametrize(
    ("robot", "normal", "friction", "before", "after"),
    (
        ("tilthex_arm", (-1.0, 0.0, 0.0), 0.3, 1.832476420, 1.821036553),
        ("panda", (0.0, 0.0, 1.0), 0.2, 4.373500943, 4.366476548),
        ("solo12", (-1.0, 0.0, 0.0), 0.3, 76.36203324, 64.56751610),
    ),
)
def test_known_results(
    robot: str, normal: tuple[float, float, float], friction: float, before: float, after: float
) -> None:
    """Compare the objective C at the initial posture and at the optimum with recorded values, without an offset."""
    problem = problem_of(robot, normal, friction, offset=(0.0, 0.0, 0.0))
    solution = solve(problem, starts=3, jobs=1, compile="never")
    assert problem.objective.value(solution.initial) == pytest.approx(before, rel=1e-8)
    assert problem.objective.value(solution.q) == pytest.approx(after, rel=1e-6)


def test_its_ends_are_the_solutions_of_speed_and_of_sticking() -> None:
    for friction, other in ((0.0, "speed"), (50.0, "sticking")):
        problem = problem_of("tilthex_arm", (-1.0, 0.0, 0.0), friction)
        same = problem_of("tilthex_arm", (-1.0, 0.0, 0.0), friction, objective=other)
        values = [p.objective.value(solve(p, starts=2, jobs=1, compile="never").q) for p in (problem, same)]
        assert values[0] == pytest.approx(values[1], rel=1e-8)


def test_an_optimum_on_the_verge_of_slipping_is_certified_by_both_sides() -> None:
    """The best posture of ur5 on this table is at the kink between sticking and slipping."""
    problem = problem_of("ur5", (0.0, 0.6, 0.8), 0.4, contact_pose="position")
    assert isinstance(problem.objective, WorstCaseObjective)
    nlp = build_nlp(problem, compile="never")
    scale, ends = problem.objective.value(problem.given), []
    for index in range(4):
        start = feasible_start(problem, index, 0)
        assert start is not None
        record, certificate = run_start(nlp, start, scale)
        assert certificate.holds()
        oracle = problem.objective.oracle
        impulse = coulomb_impact(oracle, record.q).impulse
        normal = float(oracle.n @ impulse)
        ends.append((float(np.linalg.norm(impulse - normal * oracle.n)) / normal - 0.4, record.q))
    (kink, q), *_ = sorted(ends, key=lambda end: abs(end[0]))
    assert abs(kink) < 1e-6
    sides = problem.objective.subgradients(q, 1e-6 * scale)
    assert len(sides.gradients) == 2
    assert np.abs(sides.gradients[0] - sides.gradients[1]).max() > 1e-3 * scale


def test_planar_robots_are_optimized() -> None:
    """The friction across the plane of motion has no effect, neither in the program nor in the robot."""
    robot = arm([Y, Y, Y, Y], [0.3, 0.7, -0.5, 0.4], floating=False)
    for friction in (0.0, 0.05, 0.3, 3.0):
        contact = ImpactContact(TIP, (0.6, 0.0, 0.8), friction=friction)
        objective = WorstCaseObjective(robot, contact, kind="coulomb")
        problem = build_problem(robot, objective, robot.posture(), Requirements(contact_pose="position"))
        assert solve(problem, starts=2, jobs=1, compile="never").certificate.holds()


def test_exported_code_agrees_and_names_the_gradient_at_the_switch(tmp_path: Path) -> None:
    need_compiler()
    for friction, name in ((0.25, "slides"), (3.0, "sticks"), (0.0, "smooth")):
        objective = problem_of("panda", (0.0, 0.6, 0.8), friction, normal_frame="contact").objective
        assert isinstance(objective, WorstCaseObjective)
        (tmp_path / name).mkdir()
        export([objective], tmp_path / name, prefix=name, check=False)
        header = (tmp_path / name / f"{name}.h").read_text()
        assert (
            f"friction {friction:g}; where the contact point begins to slip, grad is the gradient of sticking"
            in header
        )
        manifest = json.loads((tmp_path / name / f"{name}.json").read_text())
        assert manifest["friction"] == friction and "sticking" in manifest["objective_kink"]
        with built(tmp_path / name, name) as code:
            for q in sample_postures(objective.robot, 5, 1):
                status, value, gradient = code.objective(q)
                assert status == 0
                assert_close(value, objective.value(q), 1e-9, name)
                assert_close(gradient, objective.gradient(q), 1e-8, name, value)


def test_evaluate_shows_the_jump_with_friction() -> None:
    for friction, sticks in (("0.2", False), ("0.9", True)):
        argv = ("evaluate", "panda", "--normal", "0", "0.6", "0.8", "--friction", friction, "--speed", "2")
        document = json.loads(run(*argv, "--objective", "coulomb", "--json").stdout)
        assert document["contacts"][0]["friction"] == float(friction)
        evaluation = document["evaluation"]
        jump = evaluation["jump"]["coulomb"]
        assert jump["sticks"] is sticks and jump["friction"] == float(friction)
        assert jump["norm"] ** 2 == pytest.approx(4 * evaluation["objective"])
        assert (jump["slip_direction"] is None) is sticks
        if sticks:
            assert jump["velocity"] == evaluation["jump"]["sticking"]["velocity"]
            assert evaluation["objective"] == evaluation["S"]
        else:
            assert float(np.linalg.norm(jump["slip_direction"])) == pytest.approx(1)
            assert np.dot(jump["slip_direction"], jump["impulse"]) < 0
        words = run(*argv).stdout
        assert ("the contact point sticks" in words) is sticks and ("slides along" in words) is not sticks
        assert f"μ = {friction}" in words


def test_several_contacts_at_once_are_predicted_with_friction() -> None:
    hands = ("--contact", "gripper_left_base_link:-1,0,0", "--contact", "gripper_right_base_link:-1,0,0")
    quantities = json.loads(run("evaluate", "talos", *hands, "--json").stdout)["evaluation"]
    both = quantities["coulomb_together"]
    assert len(both) == 2 and both[0]["velocity"] == both[1]["velocity"]
    assert "all at once, with friction: gripper_left_base_link" in run("evaluate", "talos", *hands).stdout
    pulled = json.loads(run("evaluate", "talos", *hands, "--bilateral", "--json").stdout)["evaluation"]
    assert pulled["coulomb_together"] is None


def test_optimize_writes_friction_and_reads_it_again(tmp_path: Path) -> None:
    argv = "panda --normal 0 0 1 --friction 0.2 --objective coulomb --starts 2 --no-codegen --format svg --json"
    first = json.loads(run("optimize", *argv.split(), "--out", tmp_path / "a").stdout)
    again = prepare(read_settings(tmp_path / "a" / "problem.toml")).impact
    second = again.evaluate(np.array(first["optimal"]["q"])).to_dict()
    assert "friction = 0.2" in (tmp_path / "a" / "problem.toml").read_text()
    for block in (first["optimal"], second):
        assert block["jump"]["coulomb"]["friction"] == 0.2
        assert block["objective"] == pytest.approx(block["jump"]["coulomb"]["norm"] ** 2)
    assert second["objective"] == pytest.approx(first["optimal"]["objective"], rel=1e-12)


def test_evaluate_prints_the_effective_mass_as_the_objective() -> None:
    argv = "evaluate panda --normal 0 0 1 --objective effective-mass --friction".split()
    for friction in ("0", "0.3"):
        told = json.loads(run(*argv, friction, "--json").stdout)["evaluation"]
        assert told["objective"] == told["effective_mass_with_friction"]
        assert (told["objective"] == pytest.approx(told["effective_mass"])) == (friction == "0")
    assert f"objective effective-mass (m in kg, μ = 0.3): {told['objective']:.4g}" in run(*argv, "0.3").stdout


def test_bad_input_gets_one_line() -> None:
    panda, hands = ("panda", "--normal", "0", "0", "1"), ("gripper_left_base_link", "gripper_right_base_link")
    both = [word for hand in hands for word in ("--contact", f"{hand}:-1,0,0")]
    refused(run("optimize", *panda, "--objective", "coulomb", "--normal-cone", "5"), 1, "not a quadratic form")
    refused(run("evaluate", "talos", *both, "--objective", "coulomb"), 1, "one contact")
    refused(run("evaluate", *panda, "--friction", "1e300"), 1, "give 0 to 1e+100")
    for value in ("-1", "nan", "inf"):
        done = run("evaluate", *panda, "--friction", value)
        assert done.returncode == 2 and "give a number, zero or more" in done.stderr
