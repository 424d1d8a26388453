"""Timed paths: analytic durations, torque limits by RNEA between the rows, feasible contact forces."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from scipy.interpolate import BPoly
from scipy.optimize import lsq_linear

from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path import path_timing as timing
from impact_posture.path import timed_curve
from impact_posture.path.actuator_limits import ActuatorLimits
from impact_posture.path.path_curve import PathCurve
from impact_posture.path.path_files import write_path
from impact_posture.path.path_space import PathSpace
from impact_posture.path.path_timing import RATE
from impact_posture.path.posture_path import PosturePath, posture_path
from impact_posture.path.row_interpolation import RowInterpolation
from impact_posture.path.time_law import RAMP
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import PostureSolution, solve
from impact_posture.robot.actuation import allocation_matrix, thrust_limits
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.system.arrays import Array
from tests.support.arms import TIP, Z, arm, yaw_and_pitches
from tests.support.helpers import rng, robot
from tests.support.settings import make_settings

CASES: dict[str, dict[str, object]] = {
    "ur5": {"robot": "ur5", "normal": (0, 0, 1), "contact_pose": "aligned"},
    "panda": {"robot": "panda", "normal": (0, 0, 1), "contact_pose": "full"},
    "tilthex_arm": {"robot": "tilthex_arm", "normal": (0, 0, 1)},
    "solo8": {"robot": "solo8", "normal": (1, 0, 0)},
    "solo8 strike": {"robot": "solo8", "normal": (1, 0, 0), "contact_pose": "position"},
}


# Speed of the strike at the end of a path, m/s.  Other paths end at rest.
STRIKES = {"panda": 0.5, "solo8 strike": 0.5}


@cache
def solved(name: str) -> PostureSolution:
    return solve(prepare(make_settings(CASES[name])).problem, starts=4, jobs=1)


LONG = {"solo8 strike": pytest.mark.long}


@pytest.fixture(params=[pytest.param(name, marks=LONG.get(name, ())) for name in CASES], scope="module")
def moments(request: pytest.FixtureRequest) -> tuple[Robot, PosturePath, list[tuple[float, Array, Array, Array]]]:
    """A timed path, and its motion at ten instants between rows."""
    solution = solved(request.param)
    path = posture_path(solution, strike=STRIKES.get(request.param))
    assert (path.strike is None) == (request.param not in STRIKES)
    t = np.append(np.concatenate([np.linspace(a, b, 10, endpoint=False) for a, b in pairwise(path.t)]), path.t[-1])
    return solution.problem.robot, path, [(time, *path.at(time)) for time in t]


def test_positions_velocities_and_accelerations_agree(
    moments: tuple[Robot, PosturePath, list[tuple[float, Array, Array, Array]]],
) -> None:
    loaded, path, motion = moments
    t, v, a = (np.array([each[k] for each in motion]) for k in (0, 2, 3))
    dt = np.diff(t)[:, None]
    steps = np.array([pin.difference(loaded.model, one[1], other[1]) for one, other in pairwise(motion)])
    assert np.abs(steps - dt * (v[1:] + v[:-1]) / 2).max() < 1e-6
    off = np.abs(np.diff(v, axis=0) / dt - (a[1:] + a[:-1]) / 2)
    assert off.max() < 0.01 * np.abs(path.a).max()
    assert np.abs(path.v[[0] if path.strike else [0, -1]]).max() < 1e-12


def test_limits_hold_at_the_rows_and_between_them(
    moments: tuple[Robot, PosturePath, list[tuple[float, Array, Array, Array]]],
) -> None:
    """The reference is RNEA on the model of the robot, with contact forces as sums of friction cone rays."""
    loaded, path, motion = moments
    model, data = loaded.model, loaded.model.createData()
    base = loaded.first_joint
    allowed = 1.01
    fastest = max(float((np.abs(v) / model.velocityLimit).max()) for _, _, v, _ in motion)
    assert fastest <= allowed
    assert path.max_violation < 1e-8
    effort, largest = np.asarray(model.effortLimit)[base:], 0.0
    for _, q, v, a in motion[:: 1 if not base else 7]:
        load = np.array(pin.rnea(model, data, q, v, a))
        if not base:
            assert (np.abs(load) <= allowed * effort).all()
            largest = max(largest, float((np.abs(load) / effort).max()))
            continue
        matrix, low, high = forces(loaded, q)
        limits = np.concatenate([np.asarray(effort), high])
        fit = lsq_linear(
            np.hstack([np.eye(model.nv)[:, base:], matrix]), load,
            bounds=(np.concatenate([-effort, low]) - 0.01 * np.abs(limits).clip(max=1e3), allowed * limits),
        )  # fmt: skip
        assert np.abs(fit.fun).max() < 1e-5 * loaded.mass * 9.81
    if not base:
        # A timed path is as fast as possible if it reaches a limit at all times.  A strike also keeps the limits of
        # the controller on accelerations.
        v, a = (np.abs([each[k] for each in motion]) / model.velocityLimit for k in (2, 3))
        controlled = float((v**2 + 2 * a / RATE).max()) if path.strike else 0.0
        assert max(largest, fastest, controlled) > 0.98
        # The largest use in the files also includes instants between the rows.
        assert path.use is not None and path.use.largest["torque"] == pytest.approx(largest, abs=2e-3)


@pytest.mark.long(but=("normal0-ur5", "normal1-xarm7"))
@pytest.mark.parametrize("name", ["ur5", "xarm7"])
@pytest.mark.parametrize("normal", [(0, 0, 1), (-1, 0, 0)])
def test_limits_hold_for_the_trajectory_as_a_robot_interpolates_it(
    name: str, normal: tuple[float, ...], tmp_path: Path
) -> None:
    """SciPy builds the quintic polynomials that the file names, and RNEA by Pinocchio gives their torques."""
    task = {"robot": name, "normal": normal, "contact_pose": "position"}
    solution = solve(prepare(make_settings(task)).problem, starts=4, jobs=1)
    loaded, path = solution.problem.robot, posture_path(solution)
    write_path(tmp_path, loaded, path)
    text = (tmp_path / "path.yaml").read_text()
    assert "Interpolation: quintic" in text and path.to_dict()["interpolation"] == "quintic"
    points = yaml.safe_load(text)["points"]
    t = np.array([p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points])
    rows = np.array([[p["positions"], p["velocities"], p["accelerations"]] for p in points])
    q = BPoly.from_derivatives(t, rows)
    v, a = q.derivative(), q.derivative(2)
    data, largest = loaded.model.createData(), 0.0
    for time in np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in pairwise(t)]):
        load = pin.rnea(loaded.model, data, q(time), v(time), a(time))
        largest = max(largest, float((np.abs(load) / loaded.model.effortLimit).max()))
        assert (np.abs(v(time)) <= 1.01 * loaded.model.velocityLimit).all()
    assert 0.9 < largest <= 1.01
    # Additional rows are only at the bends.
    assert len(t) < 2.5 * path.duration / timed_curve.SAMPLE_TIME


def test_the_motion_between_rows_of_a_floating_base_has_the_twist_of_its_postures() -> None:
    """The rows lie on ``q(t) = q₀ ⊕ t ν₀`` with ``t ↦ t + t²``, whose twist and acceleration are known."""
    model, h = robot("tilthex_arm").model, 1e-6
    start, twist = robot("tilthex_arm").posture(), rng("twist").normal(size=model.nv)
    t = np.linspace(0.0, 0.02, 3)
    q = np.array([pin.integrate(model, start, (x + x**2) * twist) for x in t])
    rows = RowInterpolation(model, t, q, np.outer(1 + 2 * t, twist), np.outer(np.full(3, 2.0), twist))
    for time in np.linspace(1e-3, 0.019, 10):
        posture, v, a = rows.at(time)
        exact = pin.integrate(model, start, (time + time**2) * twist)
        assert np.abs(pin.difference(model, exact, posture)).max() < 1e-12
        between = pin.difference(model, rows.at(time - h)[0], rows.at(time + h)[0]) / (2 * h)
        np.testing.assert_allclose(v, between, atol=1e-8)
        np.testing.assert_allclose(v, (1 + 2 * time) * twist, atol=1e-10)
        np.testing.assert_allclose(a, 2 * twist, atol=1e-6)


def forces(loaded: Robot, q: Array) -> tuple[Array, Array, Array]:
    """Return generalized forces of unit thrusts or friction cone rays as columns, and bounds of their magnitudes."""
    if loaded.spec.propulsion is not None:
        matrix = np.vstack([allocation_matrix(loaded.model, loaded.spec.propulsion), np.zeros((loaded.nv - 6, 6))])
        low, high = thrust_limits(loaded.spec.propulsion)
        return matrix, np.full(6, low), np.full(6, high)
    data, columns = loaded.model.createData(), []
    pin.computeJointJacobians(loaded.model, data, q)
    pin.updateFramePlacements(loaded.model, data)
    for spec in loaded.spec.supports:
        assert spec.kind == "point"
        index = loaded.frame_id(spec.frame)
        J = pin.getFrameJacobian(loaded.model, data, index, pin.LOCAL_WORLD_ALIGNED)
        arm_of = data.oMf[index].rotation @ np.array(spec.offset)
        at_point = J[:3] - pin.skew(arm_of) @ J[3:]
        for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False):
            columns.append(at_point.T @ np.array([0.7 * np.cos(angle), 0.7 * np.sin(angle), 1.0]))
    return np.array(columns).T, np.zeros(len(columns)), np.full(len(columns), np.inf)


def pendulum(effort: float, *, gravity: float = 0.0) -> PathSpace:
    """Return the posture space of a hinge; its axis is horizontal with gravity and vertical without."""
    loaded = arm([(0, 1, 0) if gravity else Z], [0.0], floating=False, rods=[(0.5, 0, 0)], effort=effort)
    objective = WorstCaseObjective(loaded, ImpactContact(TIP, (0, 0, 1) if gravity else (0, 1, 0)))
    return PathSpace(build_problem(loaded, objective, loaded.posture(), Requirements(contact_pose="free")))


def limits_of(space: PathSpace) -> ActuatorLimits:
    return ActuatorLimits(space.problem.objective, space.problem.given, space.problem.requirements)


def curve_of(space: PathSpace, angle: float) -> PathCurve:
    return PathCurve(space, [space.problem.given + x for x in np.linspace(0, angle, 6)[:, None]])


@pytest.mark.parametrize(("effort", "angle"), [(0.5, 1.0), (2.0, -0.7)])
def test_a_pendulum_has_the_duration_of_bang_bang_control(effort: float, angle: float) -> None:
    """T = 2 √(I Δ/τ) for bang-bang torque, plus the ramp.  The smooth law accelerates with up to 10/√3 Δ/T²."""
    space = pendulum(effort)
    inertia = float(pin.crba(space.model, space.model.createData(), space.problem.given)[0, 0])
    limits = limits_of(space)
    assert not limits.missing
    fastest = timing.timed(space, curve_of(space, angle), limits)
    assert fastest.method == "time-optimal" and not fastest.notes
    assert fastest.rows.t[-1] == pytest.approx(2 * np.sqrt(inertia * abs(angle) / effort) + RAMP, rel=1e-4)
    smooth = timing.scaled(space, curve_of(space, angle), limits)
    assert smooth.rows.t[-1] == pytest.approx(np.sqrt(10 / np.sqrt(3) * inertia * abs(angle) / effort), rel=5e-3)


@pytest.mark.parametrize("name", ["panda", "tilthex_arm"])
def test_a_motion_is_slow_only_at_a_corner(name: str) -> None:
    loaded = robot(name)
    objective = WorstCaseObjective(loaded, ImpactContact(loaded.spec.contact.frame, (0, 0, 1)))
    space = PathSpace(build_problem(loaded, objective, loaded.posture(), Requirements(contact_pose="free")))
    moves = np.zeros((129, loaded.nv))
    first, other = (6, 7) if loaded.floating else (0, 1)
    moves[:, first] = np.interp(np.arange(129), [0, 48], [0, 0.4])
    moves[48:, other] = np.linspace(0, 0.7, 81)
    curve = PathCurve(space, [np.array(pin.integrate(loaded.model, space.problem.given, move)) for move in moves])
    motion = timing.timed(space, curve, limits_of(space))
    assert motion.method == "slowed" and not motion.notes
    limits, largest = limits_of(space), 0.0
    for q, v, a in map(motion.rows.at, motion.instants):
        shares = limits.shares(q, limits.load(q, v, a))
        assert shares is not None
        largest = max(largest, float(np.abs(shares).max()), float((np.abs(v) / loaded.velocity_limits).max()))
    assert 0.5 < largest < 1.0
    # The motion is much faster on straight parts of the curve than at its corner.
    slow = np.argmin([space.distance(q, curve.at(curve.z[48])) for q in motion.rows.q])
    assert np.abs(motion.rows.v[slow]).max() < 0.3 * np.abs(motion.rows.v).max()


def test_without_a_torque_limit_only_velocities_count() -> None:
    space = pendulum(0.0)
    limits = limits_of(space)
    motion = timing.timed(space, curve_of(space, 1.0), limits)
    assert motion.method == "scaled" and motion.notes == (
        "no effort limit of a joint is known: timed by velocities alone",
    )
    # The joint may turn at 10 rad/s.  The smooth law reaches its maximum speed of 15/8 Δ/T in the middle.
    assert np.abs(motion.rows.v).max() == pytest.approx(10.0, rel=1e-3)
    assert motion.rows.t[-1] == pytest.approx(15 / 8 / 10.0, rel=1e-3)


def test_the_known_torque_limits_count_beside_an_unknown_limit() -> None:
    """Only the first of two vertical hinges has a torque limit, so its bang-bang control determines the duration."""
    loaded = arm([Z, Z], [0.0, 0.0], floating=False, rods=[(0.5, 0, 0)] * 2, effort=0.5)
    loaded.model.effortLimit = np.array([0.5, 0.0])
    objective = WorstCaseObjective(loaded, ImpactContact(TIP, (0, 1, 0)))
    space = PathSpace(build_problem(loaded, objective, loaded.posture(), Requirements(contact_pose="free")))
    inertia = float(pin.crba(space.model, space.model.createData(), space.problem.given)[0, 0])
    curve = PathCurve(space, [space.problem.given + np.array([x, 0.0]) for x in np.linspace(0, 1.0, 6)])
    limits = limits_of(space)
    assert limits.names == ("joint_0",) and not limits.missing
    fastest = timing.timed(space, curve, limits)
    assert fastest.method == "time-optimal"
    assert fastest.rows.t[-1] == pytest.approx(2 * np.sqrt(inertia / 0.5), rel=5e-3)


def test_a_posture_that_the_motor_cannot_hold_is_named() -> None:
    space = pendulum(0.2, gravity=9.81)
    limits = limits_of(space)
    motion = timing.timed(space, curve_of(space, 0.3), limits)
    held = 0.2 * 9.81 * 0.25 / 0.2
    assert motion.notes == (f"joint_0 would need {held:.3g} times its limit at rest on the path: "
                            "timed by velocities alone",)  # fmt: skip


def test_a_floating_base_without_rotors_or_feet_has_no_limits() -> None:
    loose = replace(yaw_and_pitches(), spec=RobotSpec())
    objective = WorstCaseObjective(loose, ImpactContact(TIP, (0, 0, 1)))
    limits = ActuatorLimits(objective, loose.posture(), Requirements())
    assert limits.missing == "there are neither rotors nor feet that could hold the robot up"


def test_the_largest_rate_of_an_arm_brings_one_torque_to_its_limit() -> None:
    loaded, draw = robot("ur5"), rng("largest rate")
    limits = ActuatorLimits(WorstCaseObjective(loaded, ImpactContact(loaded.spec.contact.frame, (0, 0, 1))),
                            loaded.posture(), Requirements())  # fmt: skip
    q, effort = loaded.posture(), loaded.model.effortLimit
    rest, push = limits.load(q, np.zeros(6), np.zeros(6)), draw.normal(size=6)
    rate = limits.largest_rate(q, rest, push)
    assert rate is not None and np.max(np.abs(rest + rate * push) / effort) == pytest.approx(1, rel=1e-12)
    assert limits.largest_rate(q, rest, np.zeros(6)) == np.inf
    assert limits.largest_rate(q, 1.01 * effort, push) is None


@pytest.mark.parametrize("name", ["solo8", "go2", "anymal_c"])
def test_a_light_standing_robot_rests_and_a_slippery_one_does_not(name: str) -> None:
    """On level ground, a symmetric stance needs no friction at rest, but a lateral push requires friction."""
    loaded = robot(name)
    supports = loaded.spec.supports
    objective = WorstCaseObjective(loaded, ImpactContact(loaded.spec.contact.frame, (1, 0, 0)), supports=supports)
    q, zero = loaded.posture(), np.zeros(loaded.nv)
    limits = ActuatorLimits(objective, q, Requirements(friction=0.7))
    rest = limits.load(q, zero, zero)
    sideways = limits.load(q, zero, np.eye(loaded.nv)[1]) - rest
    shares = limits.shares(q, rest)
    assert shares is not None and np.abs(shares).max() < 1
    rate = limits.largest_rate(q, rest, sideways)
    assert rate is not None
    # Even with unlimited motors, μ g bounds the acceleration of the center of mass.
    assert 0 < rate < 0.7 * 9.81 * 1.5
    slippery = ActuatorLimits(objective, q, Requirements(friction=0.07)).largest_rate(q, rest, sideways)
    assert slippery is None or slippery < 0.3 * rate
