"""Both forms of every constraint agree, and its Jacobian agrees with finite differences on the manifold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.posture.constraints.center_of_mass_over_feet import CenterOfMassOverFeet
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.posture.constraints.pose_constraints import (
    AxisInCone,
    HeldOrientation,
    HeldPose,
    HeldPosition,
    HeldTurn,
    PositionBox,
)
from impact_posture.posture.constraints.posture_distance import WithinDistance
from impact_posture.posture.constraints.requirements import Requirements
from impact_posture.posture.formulation.build_problem import build_problem
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.arrays import independent_rows
from tests.posture.test_trade_off import all_joints
from tests.support.constraints import check_expression
from tests.support.helpers import random_configurations

Factory = Callable[[PointOnLink, pin.SE3], ExpressionConstraint]

AXIS = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
SQUARE = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
FACTORIES: dict[str, Factory] = {
    "position": lambda point, target: HeldPosition("x", point, target.translation),
    "box": lambda point, target: PositionBox("x", point, target.translation, (0.1, 0.2, 0.3)),
    "orientation": lambda point, target: HeldOrientation("x", point, target.rotation),
    "axis": lambda point, target: HeldOrientation("x", point, target.rotation, AXIS),
    "pose": lambda point, target: HeldPose("x", point, target),
    "pose, spin free": lambda point, target: HeldPose("x", point, target, AXIS),
    "turn": lambda point, target: HeldTurn(point, target.rotation, AXIS, "turn"),
    "center of mass": lambda point, target: CenterOfMassOverFeet(SQUARE, np.full(4, 0.4), 0.01),
}
ROBOTS = {
    "tilthex_arm": "ee",
    "talos": "gripper_left_base_link",
    "panda": "panda_hand",
    "kinova": "j2s6s200_end_effector",
}


def _random(robot: Robot, rng: np.random.Generator, size: float = 0.8) -> np.ndarray:
    return pin.integrate(robot.model, pin.neutral(robot.model), rng.normal(size=robot.nv) * size)


@pytest.mark.long(
    but=(
        "pose-talos",
        "center of mass-talos",
        "position-tilthex_arm",
        "box-panda",
        "orientation-kinova",
        "axis-panda",
        "pose-tilthex_arm",
        "pose-kinova",
        "pose, spin free-panda",
        "turn-kinova",
        "turn-tilthex_arm",
        "center of mass-tilthex_arm",
        "orientation-tilthex_arm",
        "box-tilthex_arm",
    )
)
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("kind", FACTORIES)
def test_constraint_agrees_with_itself_and_with_finite_differences(name: str, kind: str) -> None:
    robot, rng = load_robot(name), np.random.default_rng(3)
    point = point_on(robot, ROBOTS[name], (0.05, -0.02, 0.1))
    given = _random(robot, rng)
    constraint = FACTORIES[kind](point, Numeric(robot.model).at(given).placement(point).copy())
    # A quaternion and its negative describe the same orientation.
    turns = slice(0) if kind in ("position", "box", "center of mass") else slice(3 if "pose" in kind else 0, None)
    check_expression(constraint, robot.model, [_random(robot, rng) for _ in range(4)], turns)


def test_a_distance_agrees_with_itself_on_joints_of_all_kinds() -> None:
    chain = all_joints()
    postures = random_configurations(chain, 2, "bound")
    check_expression(WithinDistance(Chart(chain), postures[0], 0.5), chain, postures[1:])


@pytest.mark.parametrize("angle", [1e-9, 1.0, np.pi - 1e-6, np.pi])
def test_orientation_error_is_zero_at_the_target_only(angle: float) -> None:
    """At a rotation of 180°, a skew-symmetric error would vanish, but the tested error is largest."""
    robot = load_robot("tilthex_arm")
    base = PointOnLink(1, np.zeros(3), np.eye(3))
    constraint = HeldOrientation("x", base, np.eye(3))
    q = robot.posture()
    q[3:7] = pin.Quaternion(pin.exp3(angle * AXIS)).coeffs()
    numeric = Numeric(robot.model).at(q)
    value, _ = constraint.evaluate(numeric)
    assert np.linalg.norm(value) == pytest.approx(2 * np.sin(angle / 2), abs=1e-12)
    assert constraint.pose_error(value)[1] == pytest.approx(angle, abs=1e-7)


def test_level_base_leaves_yaw_free_and_nothing_else() -> None:
    robot = load_robot("tilthex_arm")
    base = PointOnLink(1, np.zeros(3), np.eye(3))
    level = HeldOrientation("level base", base, np.eye(3), np.array([0.0, 0.0, 1.0]))
    for yaw in (-3.0, -1.0, 0.5, 2.0):
        q = robot.posture()
        q[3:7] = pin.Quaternion(pin.exp3(np.array([0, 0, yaw]))).coeffs()
        assert np.abs(level.evaluate(Numeric(robot.model).at(q))[0]).max() < 1e-14
    for tilt in ([0.1, 0, 0], [0, -0.2, 0], [np.pi, 0, 0]):
        q[3:7] = pin.Quaternion(pin.exp3(np.array(tilt))).coeffs()
        assert np.abs(level.evaluate(Numeric(robot.model).at(q))[0]).max() > 0.05


def test_a_base_tilts_from_its_default_posture() -> None:
    robot = load_robot("solo8")
    q = robot.posture()
    # Rotate the base link so that its z axis is horizontal.
    q[3:7] = pin.Quaternion(pin.exp3(np.array([np.pi / 2, 0.0, 0.3]))).coeffs()
    lying = replace(robot, postures={**robot.postures, robot.default_posture: q})
    objective = WorstCaseObjective(lying, ImpactContact("base_link", (1.0, 0.0, 0.0)))
    problem = build_problem(lying, objective, q, Requirements(contact_pose="free", base="level:20"))
    tilt = next(c for c in problem.constraints if isinstance(c, AxisInCone))
    at, upright = Numeric(robot.model), pin.Quaternion(q[3:7]).matrix()
    for degrees, fits in ((0.0, True), (19.9, True), (20.1, False)):
        q[3:7] = pin.Quaternion(pin.exp3(np.deg2rad(degrees) * np.array([0.6, 0.8, 0.0])) @ upright).coeffs()
        value = tilt.evaluate(at.at(q))[0]
        assert value == pytest.approx(-np.cos(np.deg2rad(degrees)))
        assert (tilt.excess(value) == 0).all() == fits


@given(st.integers(0, 2**20), st.integers(1, 7), st.integers(1, 9), st.integers(0, 6))
def test_independent_rows_span_all_of_them(seed: int, count: int, width: int, repeats: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, width)) * rng.choice([1e-3, 1.0, 1e2], (count, 1))
    rows = rng.permutation(np.vstack([rows, rng.normal(size=(repeats, count)) @ rows, np.zeros((1, width))]))
    independent = independent_rows(rows, 1e-9)
    assert len(independent) == np.linalg.matrix_rank(rows) == np.linalg.matrix_rank(rows[independent])
