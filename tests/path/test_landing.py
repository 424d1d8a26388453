"""Strikes at several contacts: two carts at once, and the fall of a robot onto its feet and the stop after it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.controller_export.path_source import path_reference, render_path
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.follow_through import RESTITUTIONS, _stop
from impact_posture.path.path_files import read_path, write_path
from impact_posture.path.posture_path import PosturePath, posture_path
from impact_posture.path.strike import check_strike, impact_velocity
from impact_posture.path.strike_spaces import StrikeSpaces, landed
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.landing import falls_freely
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.system.arrays import Array
from impact_posture.tsid.task_formulation import legged_formulation
from impact_posture.tsid.tasks.joint_posture import JointPosture
from impact_posture_cli.optimize_summary import _path
from impact_posture_cli.output import Page
from tests.support.settings import make_settings
from tests.support.urdfs import joint, link, load

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
SPEED = 1.0


@cache
def landed_path() -> tuple[PostureSolution, PosturePath]:
    task = {
        "robot": "solo12", "contact": tuple(f"{foot}:0,0,1" for foot in FEET), "contact_pose": "position",
        "normal": None, "support": (), "base": "level", "contact_point": "front", "limit_margin": 0.5,
        "collision": False,
    }  # fmt: skip
    solution = solve(prepare(make_settings(task)).problem, starts=1, jobs=1)
    return solution, posture_path(solution, strike=SPEED, restitution=0.3)


def feet(solution: PostureSolution, q: Array) -> tuple[Array, Array]:
    """Return places, shape (4, 3), and Jacobians, shape (12, nv), of the contact points, by Pinocchio's frames."""
    model = solution.problem.robot.model
    data, places, rows = model.createData(), [], []
    pin.framesForwardKinematics(model, data, q)
    for contact in solution.problem.objective.contacts:
        index = model.getFrameId(contact.frame)
        J = pin.computeFrameJacobian(model, data, q, index, pin.LOCAL_WORLD_ALIGNED)
        arm = data.oMf[index].rotation @ np.array(contact.offset)
        rows.append(J[:3] - pin.skew(arm) @ J[3:])
        places.append(data.oMf[index].translation + arm)
    return np.array(places), np.vstack(rows)


def test_two_carts_strike_together_with_the_least_share_of_the_limits(tmp_path: Path) -> None:
    """The oracle is the linear program in all velocities, solved by SciPy."""

    def slide(speed: float) -> str:
        return f'<limit lower="-0.5" upper="0.5" effort="900" velocity="{speed}"/>'

    parts = [link("base"), link("torso", 2.0), link("left", 1.0), link("right", 1.0)]
    parts.append(joint("way", "base torso", "1 0 0", "0 0 1", "prismatic", slide(1.0)))
    parts.append(joint("a", "torso left", "1 0 0", "0 1 0", "prismatic", slide(2.0)))
    parts.append(joint("b", "torso right", "1 0 0", "0 -1 0", "prismatic", slide(3.0)))
    toml = 'default_posture = "wall"\n[postures.wall]\njoints = { way = 0.0 }\n[contact]\nframe = "left"\n'
    loaded = load(tmp_path, *parts, toml=toml)
    first, second = (ImpactContact(frame, (-1, 0, 0)) for frame in ("left", "right"))
    objective = WorstCaseObjective(loaded, first, others=(second,))
    demands = Requirements(contact_pose="position", other_poses=("position",), strike=True, approach_speed=1.5)
    solution = solve(build_problem(loaded, objective, loaded.posture(), demands), starts=1, jobs=1)
    path = posture_path(solution, strike=1.5)
    strike, limits = path.strike, loaded.velocity_limits
    assert strike is not None and not strike.hindrance and strike.follow_through is not None
    both = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    np.testing.assert_allclose(both @ path.v[-1], 1.5, atol=1e-9)
    sides = np.vstack([np.column_stack([sign * np.diag(1 / limits), -np.ones(3)]) for sign in (1, -1)])
    best = linprog(np.eye(4)[-1], sides, np.zeros(6), np.column_stack([both, np.zeros(2)]), [1.5, 1.5],
                   [(None, None)] * 3 + [(0, None)])  # fmt: skip
    assert best.fun == pytest.approx(0.5) and best.fun - 1e-7 <= strike.share <= 1.01 * best.fun
    # A plastic impact of both carts stops the two sliders.  Nothing resists the torso, so it keeps its momentum.
    np.testing.assert_allclose(both @ strike.follow_through.velocity, 0.0, atol=1e-9)


def test_a_robot_without_support_falls_on_a_parabola_without_turning() -> None:
    solution, path = landed_path()
    strike, model = path.strike, solution.problem.robot.model
    assert strike is not None and path.found and path.timing == path.method == "free fall"
    assert strike.speed == SPEED and strike.run_up_s == 0 and strike.contact_s == path.t[-1]
    assert strike.run_up_m == pytest.approx(SPEED**2 / (2 * 9.81))
    places, J = feet(solution, path.q[-1])
    np.testing.assert_allclose((J @ path.v[-1]).reshape(4, 3), np.tile([0, 0, -SPEED], (4, 1)), atol=1e-9)
    data = model.createData()
    home = np.array(pin.centerOfMass(model, data, path.q[-1]))
    for t in np.linspace(0.0, path.duration, 30):
        q, v, a = path.at(t)
        center = np.array(pin.centerOfMass(model, data, q, v))
        drop = strike.run_up_m - 9.81 * t**2 / 2
        np.testing.assert_allclose(center - home, [0, 0, drop], atol=1e-9)
        np.testing.assert_allclose(data.vcom[0], [0, 0, -9.81 * t], atol=1e-9)
        assert np.abs(pin.computeCentroidalMomentum(model, data, q, v).angular).max() < 1e-9
        assert np.abs(pin.rnea(model, data, q, v, a)).max() < 1e-6
        np.testing.assert_allclose(feet(solution, q)[0] - places, np.tile([0, 0, drop], (4, 1)), atol=1e-9)


def test_no_other_velocity_of_the_fall_needs_a_smaller_share_of_the_limits() -> None:
    """The oracle is SciPy's program in all velocities without horizontal and angular momentum."""
    solution, path = landed_path()
    robot, (_, J) = solution.problem.robot, feet(solution, path.q[-1])
    limits = robot.velocity_limits
    momentum = pin.computeCentroidalMap(robot.model, robot.model.createData(), path.q[-1])[[0, 1, 3, 4, 5]]
    np.testing.assert_allclose(momentum @ path.v[-1], 0.0, atol=1e-9)
    A = np.column_stack([np.vstack([J, momentum]), np.zeros(17)])
    b = np.append(np.tile([0.0, 0.0, -SPEED], 4), np.zeros(5))
    joints = np.flatnonzero(np.isfinite(limits))
    single = np.eye(robot.nv)[joints] / limits[joints, None]
    sides = np.vstack([np.column_stack([sign * single, -np.ones(len(joints))]) for sign in (1, -1)])
    best = linprog(
        np.eye(robot.nv + 1)[-1], sides, np.zeros(len(sides)), A, b, [(None, None)] * robot.nv + [(0, None)]
    )
    assert path.strike is not None and best.fun == pytest.approx(path.strike.share, abs=1e-9)


def test_the_velocity_after_the_landing_fulfills_the_laws_of_impact_at_all_feet() -> None:
    """Only plastic impacts are considered, because the legs press the feet onto the ground again."""
    solution, path = landed_path()
    model, after = solution.problem.robot.model, path.strike and path.strike.follow_through
    assert after
    _, J = feet(solution, path.q[-1])
    M = pin.crba(model, model.createData(), path.q[-1])
    M = np.triu(M) + np.triu(M, 1).T
    force, u = M @ (after.velocity - path.v[-1]), (J @ after.velocity).reshape(4, 3)
    p = np.linalg.lstsq(J.T, force, rcond=None)[0]
    np.testing.assert_allclose(J.T @ p, force, atol=1e-8)
    p = p.reshape(4, 3)
    friction = [contact.friction for contact in solution.problem.objective.contacts]
    assert (p[:, 2] > 0).all() and np.abs(u[:, 2]).max() < 1e-7
    side, slip = np.linalg.norm(p[:, :2], axis=1), np.linalg.norm(u[:, :2], axis=1)
    assert (side <= friction * p[:, 2] + 1e-7).all()
    assert ((slip < 1e-6) | (side > friction * p[:, 2] - 1e-6)).all()


def test_feet_that_slide_are_stopped_by_impulses_at_the_feet() -> None:
    solution, path = landed_path()
    after, q = path.strike and path.strike.follow_through, path.q[-1]
    assert after
    standing, (_, J) = landed(solution.problem, q), feet(solution, q)
    sliding = after.velocity + np.random.default_rng(2).normal(size=after.velocity.size) * 0.05
    limits = ActuatorLimits(standing.objective, q, standing.requirements)
    stop = _stop("", StrikeSpaces(standing, q), q, sliding, limits, falls=True, sample=False)
    assert not isinstance(stop, str) and np.abs(J @ sliding).max() > 0.01
    velocity = stop.moments[0][1]
    np.testing.assert_allclose(J @ velocity, 0.0, atol=1e-6)
    M = pin.crba(solution.problem.robot.model, solution.problem.robot.model.createData(), q)
    change = (np.triu(M) + np.triu(M, 1).T) @ (velocity - sliding)
    impulses = np.linalg.lstsq(J.T, change, rcond=None)[0]
    np.testing.assert_allclose(J.T @ impulses, change, atol=1e-6)


def test_the_stop_after_the_landing_is_within_the_limits_of_legs_and_ground() -> None:
    """The oracle is SciPy's program for foot forces in the friction cones, with the load by RNEA."""
    solution, path = landed_path()
    robot, after = solution.problem.robot, path.strike and path.strike.follow_through
    assert after and after.rows and after.impacts == 1 + 3 * (len(RESTITUTIONS) - 1) == after.stopped
    assert after.joints and after.joints.distance > 0
    assert after.center_of_pressure and after.center_of_pressure.distance > 0
    rows, model = after.rows, robot.model
    data, (home, _) = model.createData(), feet(solution, path.q[-1])
    assert np.abs(rows.v[-1]).max() < 1e-12 and np.array_equal(rows.q[0], path.q[-1])
    np.testing.assert_allclose(rows.v[0], after.velocity, atol=1e-5)
    angles = 2 * np.pi * np.arange(16) / 16
    cone = np.array([0.7 * np.cos(angles), 0.7 * np.sin(angles), np.ones(16)])
    for t in np.linspace(0.0, rows.t[-1], 8):
        q, v, a = rows.at(t)
        places, J = feet(solution, q)
        np.testing.assert_allclose(places, home, atol=1e-5)
        load, carried = pin.rnea(model, data, q, v, a), J.T @ np.kron(np.eye(4), cone)
        limit = model.effortLimit[6:]
        torque, zero = carried[6:], np.zeros(carried.shape[1])
        balance = linprog(zero, np.vstack([-torque, torque]), np.append(limit - load[6:], limit + load[6:]),
                          carried[:6], load[:6])  # fmt: skip
        assert balance.status == 0


def test_files_of_a_landing_are_read_back(tmp_path: Path) -> None:
    solution, path = landed_path()
    write_path(tmp_path, solution.problem.robot, path)
    assert read_path(tmp_path, path.to_dict(), solution.problem.robot).to_dict() == path.to_dict()


def test_a_robot_that_falls_lands_only_on_level_ground() -> None:
    task = {"robot": "solo12", "frame": "FL_FOOT", "normal": (0.1, 0, 1), "contact_pose": "position", "support": ()}
    with pytest.raises(InputError, match="needs level ground"):
        check_strike(prepare(make_settings(task)).problem, 1.0)


def test_a_robot_whose_contacts_turn_with_its_links_does_not_fall() -> None:
    """The ground is level in the given posture, but the normal turns with the foot."""
    task = {"robot": "solo12", "frame": "FL_FOOT", "contact_pose": "position", "support": ()}
    level = prepare(make_settings({**task, "normal": (0, 0, 1)})).problem
    up = Numeric(level.robot.model).at(level.given).placement(point_on(level.robot, "FL_FOOT")).rotation[2]
    turning = prepare(make_settings({**task, "normal": tuple(up.tolist()), "normal_frame": "contact"})).problem
    with pytest.raises(InputError, match="needs level ground"):
        check_strike(turning, 1.0)


def test_a_robot_without_gravity_does_not_fall() -> None:
    task = {"robot": "solo12", "frame": "FL_FOOT", "normal": (0, 0, 1), "contact_pose": "position", "support": ()}
    problem = prepare(make_settings(task)).problem
    weightless = replace(problem.robot, model=problem.robot.model.copy())
    floating = replace(problem, robot=weightless, objective=replace(problem.impact, robot=weightless))
    floating.robot.model.gravity.linear = np.zeros(3)
    check_strike(floating, 1.0)
    assert not falls_freely(floating.objective, "level") and falls_freely(problem.objective, "level")


def test_a_falling_robot_lands_with_its_center_of_mass_over_its_feet() -> None:
    """Without this constraint, the center of mass of the optimum is behind the feet, so no stop exists."""
    frames = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
    task = {
        "robot": "example-robot-data:a1_description/urdf/a1.urdf", "root": "free-flyer",
        "contact": tuple(f"{frame}:0,0,1" for frame in frames), "contact_pose": "position", "normal": None,
        "support": (), "base": "level", "contact_point": "front", "limit_margin": 0.2, "objective": "sticking",
        "speed": SPEED, "strike": True, "collision": False,
    }  # fmt: skip
    depths, values, stops = [], [], []
    for com in (None, False):
        solution = solve(prepare(make_settings({**task, "com": com})).problem, starts=2, jobs=1)
        model, q = solution.problem.robot.model, solution.q
        data = model.createData()
        center = np.array(pin.centerOfMass(model, data, q))[:2]
        pin.framesForwardKinematics(model, data, q)
        hull = ConvexHull([data.oMf[model.getFrameId(frame)].translation[:2] for frame in frames])
        sides, middle = hull.equations, hull.points.mean(axis=0)
        inside = [-(sides[:, :2] @ point + sides[:, 2]).max() for point in (center, middle)]
        depths.append(inside[0] / inside[1])
        values.append(solution.problem.objective.value(q))
        strike = posture_path(solution, strike=SPEED).strike
        assert strike and strike.follow_through
        stops.append(strike.follow_through.stopped)
    assert depths[0] > 0.3 - 1e-6 and depths[1] < 0 and values[0] > values[1]
    assert stops == [4, 0]
    with pytest.raises(InputError, match="no feet to keep the center of mass over"):
        prepare(make_settings({**task, "strike": False, "com": True}))


def test_a_robot_that_cannot_stand_on_its_contacts_does_not_stop() -> None:
    """On two point feet, nothing resists a rotation about the line through the feet."""
    task = {
        "robot": "solo12", "contact": ("FL_FOOT:0,0,1", "HR_FOOT:0,0,1"), "contact_pose": "position", "normal": None,
        "support": (), "base": "level", "limit_margin": 0.5,
    }  # fmt: skip
    strike = posture_path(solve(prepare(make_settings(task)).problem, starts=1, jobs=1), strike=SPEED).strike
    after = strike and strike.follow_through
    assert after and after.stopped == 0 and after.rows is None
    assert "cannot balance the robot at rest" in after.hindrance


def test_a_controller_that_stands_is_not_exported_with_a_fall() -> None:
    solution, path = landed_path()
    robot = solution.problem.robot
    structure = structure_of(robot, legged_formulation(robot, JointPosture(robot)))
    with pytest.raises(InputError, match="is a free fall"):
        render_path(structure, path_reference(robot, path, None), "ctl")


def test_two_contacts_on_a_rigid_link_cannot_arrive_along_different_normals() -> None:
    task = {
        "robot": "panda", "normal": None, "contact_pose": "position",
        "contact": ("panda_hand_tcp:0,0,1", "panda_hand_tcp:1,0,0"),
    }  # fmt: skip
    problem = prepare(make_settings(task)).problem
    assert impact_velocity(StrikeSpaces(problem, problem.given), problem.given, 1.0, 0.05) is None


def test_a_fall_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    _path(Page(), json.loads(json.dumps(landed_path()[1].to_dict())))
    text = " ".join(capsys.readouterr().out.split())
    assert "path to the optimum by free fall" in text and "4 of 4 considered impacts (restitution 0, 80%" in text
    assert "after a fall of 51 mm from rest" in text
    assert not landed_path()[1].reason
