"""The optimization compared with brute force, the certificate of wrong solutions, and the diagnosis of conflicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import Infeasible, InputError
from impact_posture.impact.impact_contact import point_on
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, read_settings, resolved_settings
from impact_posture.posture.manifold.feasible_start import Projector, StartDraw, feasible_start
from impact_posture.posture.manifold.null_space_path import null_space_path
from impact_posture.posture.program.certificate import certify, objective_gradients
from impact_posture.posture.program.constrained_problem import (
    RANK_TOLERANCE,
    ConstrainedProblem,
    equality_jacobian,
    rank,
)
from impact_posture.posture.search.multistart import distinct, solve
from impact_posture.system.arrays import nonnegative_least_squares, null_space
from tests.output.views import PENDULUM
from tests.support.biped import biped
from tests.support.pinocchio_values import central_gradient
from tests.support.settings import make_settings


def problem_of(robot: str, normal: tuple[float, float, float] = (0, 0, 1), **more: object) -> ConstrainedProblem:
    return prepare(make_settings({"robot": robot, "normal": normal, **more})).problem


def walk(problem: ConstrainedProblem, q: np.ndarray, step: float, count: int) -> list[np.ndarray]:
    """Follow the one-dimensional null space of the equalities within the joint limits."""
    projector, numeric = Projector(problem), Numeric(problem.robot.model)
    line, previous = [q], None
    for _ in range(count):
        direction = np.linalg.svd(equality_jacobian(problem, numeric.at(line[-1])))[2][-1]
        if (step if previous is None else direction @ previous) < 0:
            direction = -direction
        wish = pin.integrate(problem.robot.model, line[-1], abs(step) * direction)
        there = projector.project(wish)
        if there.violation > 1e-8 or np.abs(projector.clip(wish) - wish).max() > 1e-6:
            break
        line.append(there.q)
        previous = direction
    return line


@pytest.mark.long(
    but=("tilthex_arm-normal0-more0", "tilthex_arm-normal3-more3", "panda-normal5-more5", "xarm7-normal7-more7")
)
@pytest.mark.parametrize(
    ("robot", "normal", "more"),
    [
        ("tilthex_arm", (0, 0, 1), {}),
        ("tilthex_arm", (1, 0, 0), {}),
        ("tilthex_arm", (0, 0, 1), {"objective": "speed"}),
        ("tilthex_arm", (0.3, 0.2, 1), {"objective": "sticking", "metric": "kinetic"}),
        ("panda", (0, 0, 1), {}),
        ("panda", (1, 0, 0), {"metric": "weighted", "weights": "velocity-limits"}),
        ("xarm7", (0, 1, 1), {"objective": "energy"}),
        ("xarm7", (0, 1, 1), {"objective": "effective-mass", "friction": 0.1}),
    ],
)
def test_no_posture_along_the_null_space_is_better(
    robot: str, normal: tuple[float, float, float], more: dict
) -> None:
    """With one degree of freedom left, brute force covers all postures connected to the optimum."""
    problem = problem_of(robot, normal, **more)
    solution = solve(problem, starts=6, jobs=1)
    assert solution.redundancy == 1
    assert solution.certificate.holds()
    best = problem.objective.value(solution.q)
    line = walk(problem, solution.q, 0.02, 75) + walk(problem, solution.q, -0.02, 75)
    assert len(line) > 50
    assert min(problem.objective.value(q) for q in line) >= best * (1 - 1e-9)
    assert max(problem.objective.value(q) for q in line) > best * (1 + 1e-6)


@pytest.mark.long(
    but=(
        "solo8-more0",
        "talos-more2",
        "hextilt-more4",
        "anymal_kinova-more6",
        "kinova-more7",
        "g1-more8",
        "tiago-more9",
    )
)
@pytest.mark.parametrize(
    ("robot", "more"),
    [
        ("solo8", {"frame": "base_link"}),
        ("solo12", {"frame": "base_link"}),
        ("talos", {"frame": "torso_2_link"}),
        ("talos", {"frame": "gripper_left_base_link", "objective": "speed"}),
        ("hextilt", {}),
        ("borinot", {}),
        ("anymal_kinova", {"keep": ("LF_FOOT",), "regularization": 0.05}),
        ("kinova", {"contact_pose": "position", "objective": "sticking"}),
        ("g1", {"metric": "kinetic", "normal_frame": "contact"}),
        ("tiago", {"contact_pose": "box", "box": (0.1, 0.1, 0.05)}),
    ],
)
def test_solutions_certify_and_no_feasible_neighbor_is_better(robot: str, more: dict) -> None:
    problem = problem_of(robot, (1, 0, 0), **more)
    solution = solve(problem, starts=4, jobs=1)
    assert solution.certificate.holds()
    assert solution.reduction > -1e-9
    projector, rng = Projector(problem), np.random.default_rng(0)
    best = _cost(problem, solution.q, solution.initial)
    assert best <= _cost(problem, solution.initial, solution.initial) + 1e-9
    compared = 0
    for _ in range(30):
        wish = pin.integrate(problem.robot.model, solution.q, rng.normal(size=problem.robot.nv) * 0.02)
        there = projector.project(wish, tolerance=1e-12)
        if there.violation < 1e-9:
            compared += 1
            assert _cost(problem, there.q, solution.initial) >= best * (1 - 1e-7)
    assert compared >= 10


def _cost(problem: ConstrainedProblem, q: np.ndarray, initial: np.ndarray | None = None) -> float:
    value = problem.objective.value(q) / problem.objective.value(problem.given if initial is None else initial)
    weight = problem.requirements.regularization
    if weight:
        v = pin.difference(problem.robot.model, problem.given, q)
        quaternion = np.array(q[3:7]) @ problem.given[3:7]
        base = np.sum((q[:3] - problem.given[:3]) ** 2) + 4 * (1 - quaternion**2)
        value += weight * (base + np.sum(v[6:] ** 2))
    return float(value)


def test_certificate_refuses_postures_that_are_not_optimal() -> None:
    problem = problem_of("tilthex_arm")
    solution = solve(problem, starts=2, jobs=1)
    scale = problem.objective.value(solution.initial)
    assert not certify(problem, solution.initial, scale).holds()
    off = pin.integrate(problem.robot.model, solution.q, np.full(9, 1e-5))
    shifted = certify(problem, off, scale)
    assert shifted.pose_error_m > 1e-6 and not shifted.holds()


def test_certificate_refuses_a_multiplier_of_the_wrong_sign() -> None:
    """If the objective decreases away from a limit, the limit cannot make the posture an optimum."""
    problem = problem_of("tilthex_arm")
    scale = problem.objective.value(problem.given)
    line = walk(problem, problem.given, 0.02, 400), walk(problem, problem.given, -0.02, 400)
    ends = [part[-1] for part in line if len(part) > 5]
    assert ends and all(not certify(problem, end, scale).holds() for end in ends)


def test_multipliers_and_null_spaces_agree_with_scipy() -> None:
    rng = np.random.default_rng(0)
    for case in range(300):
        rows, columns = rng.integers(1, 20, 2)
        matrix, right = rng.normal(size=(rows, columns)), rng.normal(size=rows)
        if case % 3 == 0 and columns > 1:
            # With repeated columns there are many solutions, all with the same residual.
            matrix[:, 1] = matrix[:, 0]
        x, (_, least) = nonnegative_least_squares(matrix, right), scipy.optimize.nnls(matrix, right)
        assert x.min() >= 0
        assert np.linalg.norm(matrix @ x - right) == pytest.approx(least, abs=1e-12)
        free, expected = null_space(matrix, RANK_TOLERANCE), scipy.linalg.null_space(matrix, rcond=1e-7)
        np.testing.assert_allclose(free @ free.T, expected @ expected.T, atol=1e-12)
    assert not nonnegative_least_squares(np.zeros((3, 2)), np.ones(3)).any()
    np.testing.assert_array_equal(null_space(np.zeros((0, 3)), RANK_TOLERANCE), np.eye(3))


def test_objective_gradient_includes_the_regularization() -> None:
    problem = problem_of("talos", (1, 0, 0), frame="torso_2_link", regularization=0.3)
    q = pin.integrate(problem.robot.model, problem.given, np.random.default_rng(1).normal(size=38) * 0.2)
    (gradient,), _ = objective_gradients(problem, q, problem.objective.value(problem.given))
    slopes = central_gradient(lambda there: _cost(problem, there), problem.robot.model, q, 1e-4)
    np.testing.assert_allclose(gradient, slopes, rtol=1e-5, atol=1e-7)


def test_given_posture_is_moved_to_the_constraints() -> None:
    problem = problem_of("tilthex_arm", target_position=(0.1, 0.02, -0.55))
    solution = solve(problem, starts=3, jobs=1)
    assert solution.moved > 0.01
    reached = Numeric(problem.robot.model).at(solution.q).placement(point_on(problem.robot, "ee")).translation
    assert reached == pytest.approx([0.1, 0.02, -0.55], abs=1e-8)


@pytest.mark.usefixtures("few_tries")
def test_infeasible_names_the_conflicting_constraint() -> None:
    problem = problem_of("panda", target_position=(2.0, 0.0, 0.5))
    with pytest.raises(Infeasible, match="pose of panda_hand_tcp") as caught:
        solve(problem, starts=4, jobs=1)
    assert caught.value.exit_code == 3
    # The arm reaches 0.855 m from the shoulder, so the target is more than a meter too far.
    assert sum(caught.value.conflicts.values()) > 0.9


@pytest.mark.usefixtures("few_tries")
def test_two_constraints_in_conflict_are_both_candidates() -> None:
    problem = problem_of("tilthex_arm", base="fixed", target_position=(0.5, 0.5, -0.6))
    with pytest.raises(Infeasible) as caught:
        solve(problem, starts=2, jobs=1)
    assert set(caught.value.conflicts) & {"pose of ee", "base"}


def test_a_note_tells_that_no_redundancy_is_left() -> None:
    problem = problem_of("ur5", contact_pose="full")
    solution = solve(problem, starts=4, jobs=1)
    assert solution.redundancy == 0
    assert any("no redundancy" in note for note in solution.notes)


def test_planar_legs_get_regular_equalities() -> None:
    problem = problem_of("solo8", (1, 0, 0), frame="base_link")
    assert "base roll" in [c.name for c in problem.constraints]
    numeric, q = Numeric(problem.robot.model).at(problem.given), problem.given
    carried = [c.evaluate(numeric)[1][problem.carried(i)] for i, c in enumerate(problem.constraints) if c.equality]
    stacked = np.vstack(carried)
    assert rank(stacked) == len(stacked) == rank(equality_jacobian(problem, numeric.at(q))) == 11


def test_two_processes_find_the_same_optima() -> None:
    problem = problem_of("hextilt")
    one, two = solve(problem, starts=8, jobs=1), solve(problem, starts=8, jobs=2)
    assert np.array_equal(one.q, two.q)
    assert [o.hits for o in one.optima] == [o.hits for o in two.optima]


def test_starts_are_feasible_and_differ_by_seed() -> None:
    problem = problem_of("talos", (1, 0, 0))
    projector = Projector(problem)
    a, b = feasible_start(problem, 1, seed=0), feasible_start(problem, 1, seed=1)
    again = feasible_start(problem, 1, seed=0)
    assert a is not None and b is not None and again is not None
    assert np.array_equal(a, again) and not np.allclose(a, b)
    for q in (a, b):
        assert np.abs(projector.residual(q)[0]).max() < 1e-8
        problem.robot.check_limits(q)


def test_a_start_that_draws_more_ends_where_one_draw_does() -> None:
    problem = prepare(make_settings({"robot": "xarm7", "normal": (-1, 0, 0), "collision": True})).problem
    for index in (2, 3, 7):
        draw = StartDraw(problem, index, seed=2)
        few, many = draw.choose(3), draw.choose(20)
        assert np.array_equal(few, feasible_start(problem, index, seed=2, candidates=3))
        assert np.array_equal(many, feasible_start(problem, index, seed=2, candidates=20))


def test_distinct_counts_every_end_once() -> None:
    problem = problem_of("tilthex_arm")
    q = problem.given
    far = pin.integrate(problem.robot.model, q, np.full(9, 0.5))
    optima = distinct(problem, [(q, 1.0), (far, 1.0), (q, 1.0 + 1e-7), (far, 3.0)])
    assert [(o.objective, o.hits) for o in optima] == [(1.0, 2), (1.0, 1), (3.0, 1)]


def test_null_space_path_stays_on_the_constraints() -> None:
    problem = problem_of("tilthex_arm")
    solution = solve(problem, starts=2, jobs=1)
    path = null_space_path(problem, solution.initial, solution.q, 31)
    projector = Projector(problem)
    assert max(np.abs(projector.residual(q)[0]).max() for q in path.q) < 1e-8
    assert path.objective[0] == pytest.approx(problem.objective.value(solution.initial))
    assert path.objective[-1] == pytest.approx(problem.objective.value(solution.q))
    assert (np.diff(path.s) > 0).all()


@pytest.mark.long(but=("tilthex_arm", "solo8"))
@pytest.mark.parametrize("robot", ["tilthex_arm", "solo8", "talos"])
def test_resolved_problem_solves_to_the_same_result(robot: str, tmp_path) -> None:
    settings = make_settings({"robot": robot, "normal": (1, 0, 0), "starts": 3, "armature": {_a_joint(robot): 0.02}})
    prepared = prepare(settings)
    first = solve(prepared.problem, starts=3, jobs=1)
    file = tmp_path / "problem.toml"
    file.write_text(dump_settings(resolved_settings(prepared)))
    again = prepare(read_settings(file))
    assert again.impact.robot.model_sha256 == prepared.impact.robot.model_sha256
    assert np.array_equal(solve(again.problem, starts=3, jobs=1).q, first.q)


def _a_joint(robot: str) -> str:
    return {"tilthex_arm": "shoulder_pitch", "solo8": "FL_KFE", "talos": "torso_1_joint"}[robot]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"com": True}, "feet"),
        ({"contact": ("ee:0,0,1", "ee:0,0,2")}, "given twice"),
        ({"contact": ("ee:0,0,1", "ee:1,0,0"), "target_position": (0, 0, 0)}, "several contacts"),
        ({"bilateral": True}, "one contact"),
        ({"armature_range": (2.0, 1.0)}, "range"),
        ({"payload": (("ee", -1.0),)}, "kg above zero"),
        ({"normal_cone": 90.0}, "below 90"),
        ({"hold": ("elbwo",)}, "elbow"),
        ({"keep": ("eee",)}, "ee"),
        ({"limit_margin": 5.0}, "no room"),
        ({"target_quaternion": (0, 0, 0, 3.0)}, "norm"),
        ({"contact_pose": "free", "target_position": (0, 0, 0)}, "free"),
        ({"q": (0.0,) * 3}, "10 numbers"),
    ],
)
def test_wrong_requirements_get_one_line(more: dict, words: str) -> None:
    settings = {"robot": "tilthex_arm", "normal": (0, 0, 1), "frame": None} | more
    if "contact" in more:
        settings.pop("normal")
    with pytest.raises(InputError, match=words) as caught:
        prepare(make_settings(settings))
    assert "\n" not in caught.value.line


def test_settings_know_their_defaults() -> None:
    settings = ProblemSettings(robot="solo8", normal=(1, 0, 0))
    wanted = prepare(settings).problem.requirements
    assert wanted.com_over_feet and wanted.contact_pose == "free" and wanted.base == "free"
    settings = replace(prepare(ProblemSettings(robot="tilthex_arm", normal=(0, 0, 1))).problem.requirements)
    assert settings.base == "level" and settings.contact_pose == "full"


# ---- degenerate starts and postures -------------------------------------------------------------------------------


@pytest.mark.parametrize("more", [{"target_position": (0.4, 0.2, 0.4), "contact_pose": "full"}, {}])
def test_singular_start_drops_no_equation(more: dict) -> None:
    """The constraint rows of UR5 are dependent only in its straight posture, so no row may be dropped."""
    problem = problem_of("ur5", posture="neutral", **more)
    assert all(len(problem.carried(i)) == len(c.lifted_bounds[0]) for i, c in enumerate(problem.constraints))
    solution = solve(problem, starts=6, jobs=1)
    assert solution.certified_starts >= 4


def test_legs_without_ankle_roll_get_regular_equalities(tmp_path: Path) -> None:
    """Legs without ankle roll, as on H1, allow a sway to first order, so one of twelve equations is redundant."""
    sole = '<collision><origin xyz="0.02 0 -0.045"/><geometry><box size="0.2 0.08 0.03"/></geometry></collision>'
    (tmp_path / "biped.urdf").write_text(biped(sole, ankle_roll=False))
    supports = "".join(
        f'[[supports]]\nframe = "{side}_foot"\nkind = "surface"\noffset = [0.02, 0.0, -0.06]\n'
        for side in ("left", "right")
    )
    (tmp_path / "robot.toml").write_text(f'[model]\nroot = "free-flyer"\n{supports}')
    values = {"robot": str(tmp_path / "biped.urdf"), "frame": "hips", "contact_pose": "free", "normal": [-1, 0, 0]}
    problem = prepare(make_settings({**values, "com": True})).problem
    q = feasible_start(problem, 1, seed=0)
    assert q is not None
    carried = [
        c.evaluate(Numeric(problem.robot.model).at(q))[1][list(problem.carried(k))]
        for k, c in enumerate(problem.constraints)
        if c.equality
    ]
    assert np.linalg.svd(np.vstack(carried))[1].min() > 1e-3
    assert solve(problem, starts=4, jobs=1).certified_starts >= 2


def test_turns_that_change_nothing_are_fixed() -> None:
    """Rotating the robot about n changes nothing, also if the contact point has an offset from the pivot."""
    offset = problem_of("tilthex_arm", contact_pose="position", offset=(0.05, 0, 0))
    assert "base yaw" in [c.name for c in offset.constraints]
    sideways = problem_of("hextilt", (1, 0, 0), base="free", contact_pose="free")
    names = [c.name for c in sideways.constraints]
    assert {"base position", "base yaw", "base turn about the normal"} <= set(names)
    solution = solve(sideways, starts=6, jobs=1)
    assert solution.redundancy == sideways.robot.nv - 5


def test_impact_that_moves_nothing_is_refused() -> None:
    """Both hinges of the pendulum rotate about x."""
    for objective in ("impulse", "speed"):
        problem = problem_of(PENDULUM, (1, 0, 0), frame="link2", contact_pose="free", objective=objective)
        with pytest.raises(InputError, match="cannot move along the normal"):
            solve(problem, starts=2, jobs=1)


def test_regularized_solution_has_the_least_cost_of_all_optima() -> None:
    problem = problem_of("tilthex_arm", (1, 0, 0), contact_pose="position", regularization=0.2)
    solution = solve(problem, starts=12, jobs=1)
    best = _cost(problem, solution.q, solution.initial)
    assert all(_cost(problem, other.q, solution.initial) >= best - 1e-9 for other in solution.optima)


@pytest.mark.parametrize(
    ("text", "over", "expected"),
    [
        ("starts = 3", {"starts": 5}, {"starts": 5}),
        ('metric = "weighted"\nweights = [1.0]', {"metric": "kinetic"}, {"metric": "kinetic", "weights": None}),
        ('contact = "ee:1,0,0"', {"normal": (0, 0, 1)}, {"contact": None, "normal": (0, 0, 1)}),
        ("normal = [0, 0, 1]", {"contact": ("ee:1,0,0",)}, {"normal": None}),
        ("normal = [0, 0, 1]\nq = [0.0]", {"posture": "home"}, {"q": None, "posture": "home"}),
    ],
)
def test_an_option_replaces_equivalent_keys_of_the_file(text: str, over: dict, expected: dict, tmp_path) -> None:
    file = tmp_path / "problem.toml"
    file.write_text(f'robot = "tilthex_arm"\n{text}\n')
    settings = read_settings(file, over)
    for key, value in expected.items():
        assert getattr(settings, key) == value


def test_listed_weights_need_the_weighted_metric(tmp_path) -> None:
    with pytest.raises(InputError, match="metric is kinetic"):
        prepare(make_settings({"robot": "panda", "normal": (0, 0, 1), "metric": "kinetic", "weights": (1.0,) * 9}))
