"""Strikes: the velocity at the impact, the run-up, and what limits the speed."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog

from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.output.report.result_report import result_scene
from impact_posture.output.result_reader import load_result
from impact_posture.path.path_files import read_path, write_path
from impact_posture.path.path_space import PathSpace
from impact_posture.path.posture_path import PosturePath, posture_path
from impact_posture.path.strike import _RATE, StrikeSpaces, _tipping, check_strike, impact_velocity
from impact_posture.path.stroke import SHARE
from impact_posture.posture.approach.approach_speed import ApproachSpeed
from impact_posture.posture.approach.attainable_speed import RUN_UP
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.clearance import Clearance
from impact_posture.posture.constraints.impact_bounds import ImpactBounds
from impact_posture.posture.constraints.pose_constraints import PositionAlong
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, equality_jacobian
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.system.arrays import Array
from tests.support.command import run, succeed
from tests.support.constraints import check_expression
from tests.support.helpers import rng, robot
from tests.support.settings import make_settings
from tests.support.urdfs import joint, link, load, write

SPEED = 0.5
CASES: dict[str, dict[str, object]] = {
    "ur5": {"robot": "ur5", "normal": (0, 0, 1), "contact_pose": "aligned", "collision": True, "holdable": True},
    "panda": {"robot": "panda", "normal": (0, 0, 1), "approach": False},
    "tilthex_arm": {"robot": "tilthex_arm", "normal": (-1, 0, 0)},
    "solo8": {"robot": "solo8", "normal": (1, 0, 0), "contact_pose": "position"},
}


@cache
def struck(name: str) -> tuple[PostureSolution, PosturePath]:
    solution = solve(prepare(make_settings(CASES[name])).problem, starts=3, jobs=1)
    return solution, posture_path(solution, strike=SPEED)


def contact_of(problem: ConstrainedProblem, q: Array) -> tuple[pin.SE3, Array]:
    """Return the placement and the Jacobian of the contact point, by Pinocchio's frames."""
    (contact,), model = problem.objective.contacts, problem.robot.model
    data, index = model.createData(), model.getFrameId(contact.frame)
    pin.framesForwardKinematics(model, data, q)
    J = pin.computeFrameJacobian(model, data, q, index, pin.LOCAL_WORLD_ALIGNED)
    arm = data.oMf[index].rotation @ np.array(contact.offset)
    J = np.vstack([J[:3] - pin.skew(arm) @ J[3:], J[3:]])
    return pin.SE3(data.oMf[index].rotation, data.oMf[index].translation + arm), J


@pytest.mark.long(but=("solo8", "tilthex_arm", "panda"))
@pytest.mark.parametrize("name", CASES)
def test_the_path_arrives_at_the_optimum_with_the_stated_velocity(name: str) -> None:
    solution, path = struck(name)
    problem, strike = solution.problem, path.strike
    assert path.found and strike is not None and not strike.hindrance and strike.speed == SPEED
    assert strike.contact_s == path.t[-1] and np.array_equal(strike.velocity, path.v[-1])
    assert np.abs(pin.difference(problem.robot.model, path.q[-1], solution.q)).max() < 1e-8
    n = np.array(problem.objective.contacts[0].normal)
    twist = contact_of(problem, path.q[-1])[1] @ path.v[-1]
    assert np.abs(twist[:3] + SPEED * n).max() < 1e-9
    pose = problem.requirements.contact_pose
    turning = {"full": np.eye(3), "aligned": np.eye(3) - np.outer(n, n), "position": np.zeros((3, 3))}[pose]
    assert np.abs(turning @ twist[3:]).max() < 1e-9
    assert np.isfinite(problem.robot.velocity_limits).any()
    share = float((np.abs(path.v[-1]) / problem.robot.velocity_limits).max())
    assert share == pytest.approx(strike.share, abs=1e-9) and share <= 1


@pytest.mark.parametrize("name", CASES)
def test_the_run_up_is_straight_and_clear_and_keeps_feet_and_base(name: str) -> None:
    solution, path = struck(name)
    problem, strike = solution.problem, path.strike
    assert strike is not None
    n, model = np.array(problem.objective.contacts[0].normal), problem.robot.model
    home = contact_of(problem, path.q[-1])[0]
    times, rests = np.linspace(strike.run_up_s, strike.contact_s, 40), strike.rest_s == strike.run_up_s
    assert rests == (problem.robot.floating)
    heights = []
    for t in times:
        q, v, _ = path.at(t)
        at, J = contact_of(problem, q)
        off = at.translation - home.translation
        heights.append(float(n @ off))
        assert np.linalg.norm(off - heights[-1] * n) < 1e-5
        if problem.requirements.contact_pose == "full":
            assert np.abs(pin.log3(at.rotation.T @ home.rotation)).max() < 1e-5
        # The speed rises as 3τ² − 2τ³, or is constant before the contact if an arm does not rest before the run-up.
        share = (t - strike.run_up_s) / (strike.contact_s - strike.run_up_s)
        assert -n @ J[:3] @ v <= 1.01 * SPEED
        if rests or strike.contact_s - t < 5e-3:
            planned = SPEED * (3 * share**2 - 2 * share**3 if rests else 1.0)
            assert -n @ J[:3] @ v == pytest.approx(planned, abs=5e-3 * SPEED)
        for constraint in problem.constraints[: len(problem.objective.supports)]:
            assert np.abs(constraint.value(Numeric(model).at(q))).max() < 1e-5
        if problem.surroundings is not None:
            assert not problem.surroundings.collisions(q)
    assert heights[0] == pytest.approx(strike.run_up_m, rel=1e-3) and (np.diff(heights) < 0).all()
    # The contact point is not in the surface at any earlier posture.
    assert np.abs(path.at(strike.rest_s)[1]).max() < 1e-9
    assert min(n @ (contact_of(problem, q)[0].translation - home.translation) for q in path.q) > -1e-6


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_the_velocity_at_the_impact_needs_the_least_share_of_the_limits(name: str) -> None:
    """The oracle is the linear program in all velocities, solved by SciPy."""
    solution, path = struck(name)
    problem, strike = solution.problem, path.strike
    assert strike is not None
    q, nv, limit = path.q[-1], problem.robot.nv, problem.robot.velocity_limits
    J, n = contact_of(problem, q)[1], np.array(problem.objective.contacts[0].normal)
    held = [c.evaluate(Numeric(problem.robot.model).at(q))[1] for c in problem.constraints if c.equality]
    tilt = np.vstack(held)[3:] if problem.requirements.contact_pose != "position" else np.zeros((0, nv))
    A = np.column_stack([np.vstack([J[:3], tilt]), np.zeros(3 + len(tilt))])
    bounds = [(None, None)] * nv + [(0, None)]
    sides = np.vstack([np.column_stack([sign * np.diag(1 / limit), -np.ones(nv)]) for sign in (1, -1)])
    b = np.concatenate([-SPEED * n, np.zeros(len(tilt))])
    best = linprog(np.eye(nv + 1)[-1], sides, np.zeros(2 * nv), A, b, bounds)
    assert best.status == 0 and best.fun - 1e-7 <= strike.share <= 1.01 * best.fun


def test_velocities_that_leave_an_active_bound_are_preferred() -> None:
    """A limit of a joint at the optimum allows only run-ups away from the limit."""
    solution, path = struck("panda")
    at, worst = path.q[-1], int(np.abs(path.v[-1]).argmax())
    sign, lower, upper = np.sign(path.v[-1][worst]), solution.problem.lower.copy(), solution.problem.upper.copy()
    # The run-up begins at q − t ν, and the new limit forbids this posture.
    (lower if sign > 0 else upper)[worst] = at[worst]
    blocked = replace(solution.problem, lower=lower, upper=upper)
    velocity = impact_velocity(StrikeSpaces(blocked, at), at, SPEED, 0.05, inside=True)
    assert velocity is not None and sign * velocity[0][worst] <= -_RATE * SPEED * (1 - 1e-6)


def test_a_balanced_velocity_keeps_the_capture_point_away_from_the_edges_of_the_feet() -> None:
    solution, path = struck("solo8")
    problem, q, distances = solution.problem, path.q[-1], []
    loaded, data = problem.robot, problem.robot.model.createData()
    pin.framesForwardKinematics(loaded.model, data, q)
    feet = [data.oMf[loaded.frame_id(support.frame)].translation for support in problem.objective.supports]
    edges = polygon_edges(foot[:2] for foot in feet)
    assert edges is not None
    for balanced in (True, False):
        velocity = impact_velocity(StrikeSpaces(problem, q), q, SPEED, 0.05, balanced=balanced)
        assert velocity is not None
        com, speed = pin.centerOfMass(loaded.model, data, q, velocity[0]), data.vcom[0]
        capture = com + speed * np.sqrt((com[2] - feet[0][2]) / 9.81)
        distances.append((edges[1] - edges[0] @ capture[:2]).min())
    assert distances[0] > distances[1] + 0.01


def test_at_the_edge_of_the_feet_the_capture_point_does_not_move_outwards() -> None:
    solution, path = struck("solo8")
    problem, model = solution.problem, Numeric(solution.problem.robot.model).at(path.q[-1])
    (over,) = (c for c in problem.constraints if isinstance(c, CenterOfMassOverFeet))
    distances, jacobian = over.evaluate(model)
    for distance in (-1e-12, 0.0, 1e-12):
        edge = CenterOfMassOverFeet(over.normals, over.offsets + distances[0] - distance, 0.0)
        others = (edge if c is over else c for c in problem.constraints)
        row = _tipping(replace(problem, constraints=tuple(others)), model)[0]
        assert np.isfinite(row).all() and row @ jacobian[0] > 0


def test_links_that_are_slightly_too_near_are_separated() -> None:
    problem = prepare(make_settings({**CASES["ur5"], "contact_pose": "position"})).problem
    space, draws, near = PathSpace(problem), rng("near"), list[Array]()
    while not near:
        drawn = pin.integrate(problem.robot.model, problem.given, draws.normal(size=problem.robot.nv))
        q = space.projector.project(drawn).q
        # Clearances are not projected, so a clearance can have the largest violation.
        worst = max(space.violations(q), key=lambda each: each[1])
        if "surface" in worst[0] and 1e-3 < worst[1] < 5e-3:
            near.append(q)
    apart = space.apart(near[0])
    assert apart is not None and space.valid(apart) and space.distance(near[0], apart) < 0.2


WALL = 'default_posture = "wall"\n[postures.wall]\njoints = { slide = 0.0 }\n[contact]\nframe = "cart"\n'


def cart(effort: float, speed: float) -> tuple[str, ...]:
    """Return a mass of 2 kg on a slider towards a wall at 0; it can back off by 0.1 m."""
    limit = f'<limit lower="-0.1" upper="1" effort="{effort}" velocity="{speed}"/>'
    return link("base"), link("cart", 2.0), joint("slide", "base cart", "1 0 0", "0 0 1", "prismatic", limit)


def slider(folder: Path, effort: float, speed: float, cone: float = 0.0) -> PostureSolution:
    loaded = load(folder, *cart(effort, speed), toml=WALL)
    objective = WorstCaseObjective(loaded, ImpactContact("cart", (-1, 0, 0)), normal_cone_deg=cone)
    problem = build_problem(loaded, objective, loaded.posture(), Requirements(contact_pose="position"))
    return solve(problem, starts=1, jobs=1)


def test_the_greatest_speed_of_a_cart_follows_from_its_run_up(tmp_path: Path) -> None:
    """The speed 3τ² − 2τ³ over a length L has the acceleration 3/4 v²/L, which the force of the motor bounds."""
    path = posture_path(slider(tmp_path, 4.0, 9.0), strike=2.0)
    strike = path.strike
    greatest = np.sqrt(SHARE * 4.0 / 2.0 * 0.1 / 0.75)
    assert strike is not None and strike.speed == pytest.approx(greatest, rel=0.02) and strike.speed < greatest
    assert strike.hindrance == "the torque of slide, and the motion cannot be longer because of joint limits"
    assert strike.run_up_m == pytest.approx(0.1, rel=0.05) and path.found


def test_a_run_up_is_not_shorter_than_a_controller_can_follow(tmp_path: Path) -> None:
    """The run-up of 0.1 s to 2 m/s needs the whole room of 0.1 m."""
    strike = posture_path(slider(tmp_path, 4000.0, 9.0), strike=5.0).strike
    assert strike is not None and strike.contact_s - strike.run_up_s >= RUN_UP
    assert strike.speed == pytest.approx(2.0, rel=0.02) and strike.speed <= 2.0
    assert strike.hindrance == (
        "the shortest run-up of 0.1 s, and the motion cannot be longer because of joint limits"
    )


def test_the_reason_is_the_missing_path_if_another_optimum_is_not_faster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution, module = slider(tmp_path, 4.0, 9.0), "impact_posture.path.posture_path"
    monkeypatch.setattr(f"{module}._targets", lambda solution, space: enumerate([solution.q, solution.q]))
    answers = iter(["no path leads to the beginning of the run-up"])
    monkeypatch.setattr(f"{module}._led", lambda start, run, *_: next(answers, (run, "continuation")))
    path = posture_path(solution, strike=2.0)
    assert path.strike is not None and path.strike.hindrance
    assert path.reason.startswith("no path leads to the beginning of the run-up; the path ends at optimum number 2")


def test_a_velocity_limit_bounds_the_speed(tmp_path: Path) -> None:
    path = posture_path(slider(tmp_path, 4000.0, 0.7), strike=2.0)
    assert path.strike is not None and path.strike.hindrance == "the velocity of slide"
    assert path.strike.speed == pytest.approx(0.7, rel=1e-6) and path.strike.share == pytest.approx(1.0)


def test_a_motor_that_cannot_move_the_cart_ends_the_path_at_rest(tmp_path: Path) -> None:
    """A path at rest ends at the start, because the start is the optimum."""
    path = posture_path(slider(tmp_path, 1e-9, 9.0), strike=2.0)
    assert path.strike is None and len(path.t) == 1


def test_positions_along_directions_agree_with_casadi_and_finite_differences() -> None:
    loaded = robot("panda")
    directions, point = rng("directions").normal(size=(2, 3)), point_on(loaded, "panda_hand_tcp", (0.01, 0.02, 0.03))
    row = PositionAlong("along", point, np.ones(3), directions, 0.0, 1.0)
    check_expression(row, loaded.model, [loaded.posture(), loaded.posture() + 0.1])


def test_constraints_on_the_impact_do_not_hold_on_the_way() -> None:
    task: dict[str, object] = {**CASES["ur5"], "speed": 0.5, "max_joint_jump": 9.0}
    problem = prepare(make_settings(task)).problem
    at_impact = [c for c in problem.constraints if c.at_impact]
    assert [type(c) for c in at_impact] == [ImpactBounds, ApproachSpeed]
    spaces = StrikeSpaces(problem, problem.given)
    for space in (spaces.approach, spaces.run_up, spaces.rebound):
        assert not {id(c) for c in at_impact} & {id(c) for c in space.problem.constraints}
        assert any(isinstance(c, Clearance) for c in space.problem.constraints)


def test_the_surface_stays_in_the_world_while_the_contact_backs_off() -> None:
    """The surface of the problem follows the contact point.  So it is nearer to the other links before the run-up."""
    (solution, path), numeric = struck("ur5"), Numeric(robot("ur5").model)
    spaces, strike = StrikeSpaces(solution.problem, path.q[-1]), path.strike
    assert strike is not None
    numeric.at(path.at(strike.run_up_s)[0])
    surfaces = [
        next(c for c in problem.constraints if isinstance(c, Clearance) and c.name.startswith("surface"))
        for problem in (spaces.run_up.problem, solution.problem)
    ]
    (name, fixed), (same, moving) = (surface.closest(numeric) for surface in surfaces)
    assert name == same and fixed - moving == pytest.approx(strike.run_up_m, rel=1e-3)


def test_files_mark_the_contact(tmp_path: Path) -> None:
    solution, path = struck("solo8")
    loaded, strike = solution.problem.robot, path.strike
    assert strike is not None
    write_path(tmp_path, loaded, path)
    with (tmp_path / "path.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["contact"] for row in table] == [*["0"] * (len(path.t) - 1), "1"]
    assert float(table[-1]["t"]) == np.load(tmp_path / "path.npz")["contact"] == strike.contact_s
    assert f"# The contact is at the last point, at {strike.contact_s:.9g} s." in (tmp_path / "path.yaml").read_text()
    block = json.loads(json.dumps(path.to_dict(), allow_nan=False))
    assert read_path(tmp_path, block, loaded).to_dict() == path.to_dict()
    page = (Path(__file__).parents[2] / "docs" / "reference" / "result-json.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `path.strike")]
    assert all(f"`{key}`" in rows[0] for key in block["strike"])
    assert all(f"`{key}`" in rows[1] for key in block["strike"]["follow_through"])
    with (tmp_path / "follow_through.csv").open(newline="") as file:
        first = next(csv.DictReader(file))
    assert (first["t"], first["contact"]) == ("0.0", "1")
    played = path.played
    assert played.t[len(path.t) - 1] == strike.contact_s and (np.diff(played.t) > 0).all()
    assert len(played.t) == len(played.q) == len(played.v) and not played.v[-1].any()
    block["strike"]["velocity"].pop()
    with pytest.raises(ValueError, match="does not fit solo8"):
        read_path(tmp_path, block, loaded)


# How a strike is damaged: an entry of its block is replaced, or only these rows of a file are kept.
DAMAGED: dict[str, dict[str, object]] = {
    "text": {"run_up_s": "x"},
    "no number": {"share": None},
    "run-up after the contact": {"run_up_s": 99.0},
    "negative speed": {"speed": -1.0},
    "other velocity": {"velocity": [0.0] * 14},
    "one row": {"follow_through": slice(0, 1)},
    "late begin": {"follow_through": slice(1, None)},
    "path without contact": {"path": slice(0, -1)},
}


@pytest.mark.parametrize("how", DAMAGED)
def test_a_damaged_strike_is_refused(how: str, tmp_path: Path) -> None:
    solution, path = struck("solo8")
    write_path(tmp_path, solution.problem.robot, path)
    block = json.loads(json.dumps(path.to_dict()))
    for key, value in DAMAGED[how].items():
        if isinstance(value, slice):
            with np.load(tmp_path / f"{key}.npz") as file:
                arrays = {name: array[value] if name in "tqva" else array for name, array in file.items()}
            np.savez(tmp_path / f"{key}.npz", **arrays)
        else:
            block["strike"][key] = value
    with pytest.raises(ValueError, match=r"fit|begin|times"):
        read_path(tmp_path, block, solution.problem.robot)


def test_the_command_prints_the_strike_and_what_bounds_it(tmp_path: Path) -> None:
    robot_file = write(tmp_path, *cart(4.0, 9.0), toml=WALL)
    options = "--normal -1 0 0 --contact-pose position --no-holdable --no-approach --speed 2 --no-codegen --no-report"
    command = ("optimize", robot_file, *options.split(), "--format", "png", "--strike")
    idle = run(*command, cwd=tmp_path)
    assert idle.returncode == 2 and "'--strike': does nothing without --path" in " ".join(idle.stderr.split())
    done = succeed(*command, "--path", "--out", "out", cwd=tmp_path)
    text = " ".join(done.stdout.split())
    assert "then stops within" in text and "of 7 considered impacts" in text
    assert "strikes at 0.5 m/s, with 6% of the velocity limits" in text
    assert "2 m/s is not possible, because of the torque of slide" in text
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert "strike = true" in (tmp_path / "out" / "problem.toml").read_text()
    # The verdict states first that the stated speed is not reached.
    assert document["verdict"]["line"].startswith("verdict: cannot arrive at 2 m/s (0.5 m/s at most)")
    # The page plays the path, the contact and the stop.
    prepared, view, _ = load_result(tmp_path / "out")
    (track,) = result_scene(prepared, view).tracks
    strike, speed = document["path"]["strike"], {name: values for name, _, values in track.curves}
    assert track.times[-1] == pytest.approx(strike["contact_s"] + strike["follow_through"]["duration_s"])
    towards = speed["speed of the contact towards the surface"]
    assert towards[list(track.times).index(strike["contact_s"])] == pytest.approx(strike["speed"]) == towards.max()
    assert speed["largest share of a velocity limit"].max() == pytest.approx(strike["speed"] / 9.0)


@pytest.mark.parametrize(
    ("settings", "speed", "words"),
    [
        ({"contact_pose": "free"}, 1.0, "`contact_pose` is free"),
        ({"contact_pose": "position"}, 0.0, "speed above zero"),
        ({"normal": None, "contact": ("panda_hand_tcp:0,0,1",), "contact_pose": "box"}, 1.0, "is box"),
    ],
)
def test_a_contact_that_cannot_strike_is_refused(settings: dict[str, object], speed: float, words: str) -> None:
    problem = prepare(make_settings({"robot": "panda", "normal": (0, 0, 1), **settings})).problem
    with pytest.raises(InputError, match=words):
        check_strike(problem, speed)


def test_equalities_of_the_run_up_leave_the_normal_free() -> None:
    solution, path = struck("panda")
    spaces = StrikeSpaces(solution.problem, path.q[-1])
    rows = equality_jacobian(spaces.run_up.problem, Numeric(solution.problem.robot.model).at(path.q[-1]))
    held = equality_jacobian(solution.problem, Numeric(solution.problem.robot.model).at(path.q[-1]))
    assert np.linalg.matrix_rank(rows, tol=1e-7) == np.linalg.matrix_rank(held, tol=1e-7) - 1
