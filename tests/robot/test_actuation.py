"""Rotors and motors: thrust allocation, hovering in every named posture, and lateral force."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import impact_posture_robots
from impact_posture.config.table_validation import validate
from impact_posture.errors import FrameNotFound, PostureError, SpecError
from impact_posture.robot.actuation import (
    actuation_matrix,
    allocation,
    allocation_matrix,
    hover,
    lateral_force_range,
    thrust_limits,
)
from impact_posture.robot.robot_spec import PropulsionSpec, RotorSpec, read_spec

FOLDER = Path(impact_posture_robots.__path__[0]) / "tilthex_arm"
POSTURES = ["home", "tucked", "brace_down", "brace_forward", "brace_up"]


@pytest.fixture(scope="module")
def propulsion() -> PropulsionSpec:
    result = read_spec(FOLDER / "robot.toml").propulsion
    assert result is not None
    return result


@pytest.fixture(scope="module")
def model() -> pin.Model:
    model = pin.buildModelFromUrdf(str(FOLDER / "tilthex_arm.urdf"), pin.JointModelFreeFlyer())
    pin.loadReferenceConfigurations(model, str(FOLDER / "tilthex_arm.srdf"), False)
    return model


def flat(count: int, **changes: object) -> PropulsionSpec:
    """Return coplanar rotors whose thrusts all point up."""
    rotors = [
        RotorSpec(
            name=f"r{i}",
            position=(0.3 * np.cos(2 * np.pi * i / count), 0.3 * np.sin(2 * np.pi * i / count), 0.0),
            direction=(0.0, 0.0, 1.0),
            spin=1 if i % 2 else -1,
        )
        for i in range(count)
    ]
    values: dict[str, object] = {
        "frame": "base_link",
        "thrust_coefficient": 1e-3,
        "drag_ratio": 0.02,
        "speed_min": 0.0,
        "speed_max": 120.0,
        "time_constant_up": 0.01,
        "time_constant_down": 0.02,
        "rotors": tuple(rotors),
    }
    return validate(PropulsionSpec, values | changes, "propulsion")


def test_allocation_is_full_and_well_conditioned(model: pin.Model, propulsion: PropulsionSpec) -> None:
    result = allocation(model, propulsion)
    assert result.matrix.shape == (6, 6)
    assert result.rank == 6
    assert result.condition == pytest.approx(6.0, abs=0.05)


def test_rotor_directions_follow_the_stated_tilts(propulsion: PropulsionSpec) -> None:
    for i, rotor in enumerate(propulsion.rotors):
        angle = np.radians(30 + 60 * i)
        alpha, beta = np.radians(21 if i % 2 == 0 else -21), np.radians(-19)
        turned = (
            pin.AngleAxis(angle, np.array([0.0, 0.0, 1.0])).matrix()
            @ pin.AngleAxis(alpha, np.array([1.0, 0.0, 0.0])).matrix()
            @ pin.AngleAxis(beta, np.array([0.0, 1.0, 0.0])).matrix()
        )
        np.testing.assert_allclose(rotor.direction, turned[:, 2], atol=1e-8)
        np.testing.assert_allclose(rotor.position, [0.39 * np.cos(angle), 0.39 * np.sin(angle), 0.0], atol=1e-8)


def test_one_rotor_by_hand(model: pin.Model) -> None:
    # The rotor is 0.5 m ahead, pushes up, and has spin +1, so its drag torque is -κ f about the thrust.
    one = RotorSpec(name="r", position=(0.5, 0.0, 0.0), direction=(0.0, 0.0, 1.0), spin=1)
    matrix = allocation_matrix(model, flat(4, rotors=(one,)))
    np.testing.assert_allclose(matrix[:, 0], [0, 0, 1, 0, -0.5, -0.02], atol=1e-15)


def test_propulsion_frame_apart_from_the_base(model: pin.Model) -> None:
    shifted = pin.Model(model)
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.1, 0.2, 0.3]))
    shifted.addFrame(pin.Frame("mount", 1, 0, placement, pin.FrameType.OP_FRAME))
    spec = flat(4)
    expected = np.column_stack(
        [
            np.r_[f, np.cross(placement.translation, f) + placement.rotation @ m]
            for f, m in ((placement.rotation @ c[:3], c[3:]) for c in allocation_matrix(model, spec).T)
        ]
    )
    matrix = allocation_matrix(shifted, flat(4, frame="mount"))
    np.testing.assert_allclose(matrix, expected, atol=1e-14)


def test_actuation_matrix(model: pin.Model, propulsion: PropulsionSpec) -> None:
    matrix = actuation_matrix(model, propulsion)
    assert matrix.shape == (9, 9)
    np.testing.assert_array_equal(matrix[:6, :6], allocation_matrix(model, propulsion))
    np.testing.assert_array_equal(matrix[6:, 6:], np.eye(3))
    assert not matrix[:6, 6:].any() and not matrix[6:, :6].any()
    np.testing.assert_array_equal(actuation_matrix(model), np.vstack([np.zeros((6, 3)), np.eye(3)]))
    fixed = pin.buildModelFromUrdf(str(FOLDER / "tilthex_arm.urdf"))
    np.testing.assert_array_equal(actuation_matrix(fixed), np.eye(3))


@pytest.mark.parametrize("posture", POSTURES)
def test_hovers_level_in_every_named_posture(posture: str, model: pin.Model, propulsion: PropulsionSpec) -> None:
    q = model.referenceConfigurations[posture]
    result = hover(model, propulsion, q)
    assert result.feasible, result.violations
    assert result.residual < 1e-10
    assert result.thrust_margin > 0.25
    assert result.torque_margin > 0.75
    np.testing.assert_allclose(propulsion.thrust_coefficient * result.speeds**2, result.thrusts)
    # Check with inverse and forward dynamics that the computed thrusts and torques give zero acceleration.
    inputs = np.r_[result.thrusts, result.joint_torques]
    forces = actuation_matrix(model, propulsion) @ inputs
    zero = np.zeros(model.nv)
    np.testing.assert_allclose(pin.rnea(model, model.createData(), q, zero, zero), forces, atol=1e-10)
    np.testing.assert_allclose(pin.aba(model, model.createData(), q, zero, forces), zero, atol=1e-8)


@pytest.mark.parametrize("posture", POSTURES)
def test_lateral_force_is_about_five_newtons(posture: str, model: pin.Model, propulsion: PropulsionSpec) -> None:
    force = lateral_force_range(model, propulsion, model.referenceConfigurations[posture])
    assert pin.computeTotalMass(model) == pytest.approx(3.02)
    for value in (force.forward, force.backward, force.left, force.right):
        assert 3.0 < value < 6.0
    # The arm moves in the symmetry plane of the robot.
    assert force.left == pytest.approx(force.right, rel=1e-6)


def test_lateral_force_is_the_last_feasible_one(model: pin.Model, propulsion: PropulsionSpec) -> None:
    # Six rotors determine the thrusts uniquely: at the reported lateral force, one rotor is at a limit.
    q = model.referenceConfigurations["brace_forward"]
    force_range = lateral_force_range(model, propulsion, q)
    low, high = thrust_limits(propulsion)
    matrix = allocation_matrix(model, propulsion)
    directions = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
    for direction, force in zip(directions, vars(force_range).values(), strict=True):
        acceleration = np.r_[np.array(direction) * force / pin.computeTotalMass(model), np.zeros(model.nv - 3)]
        wrench = pin.rnea(model, model.createData(), q, np.zeros(model.nv), acceleration)[:6]
        thrusts = np.linalg.solve(matrix, wrench)
        assert min(np.min(thrusts - low), np.min(high - thrusts)) == pytest.approx(0.0, abs=1e-6)


def test_lateral_force_turns_with_the_heading(model: pin.Model, propulsion: PropulsionSpec) -> None:
    q = np.array(model.referenceConfigurations["home"])
    straight = lateral_force_range(model, propulsion, q)
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, 0.0, 0.7)).coeffs()
    turned = lateral_force_range(model, propulsion, q)
    assert turned.forward == pytest.approx(straight.forward)
    assert turned.right == pytest.approx(straight.right)


def test_coplanar_rotors_hover_but_cannot_push_sideways(model: pin.Model) -> None:
    q = model.referenceConfigurations["home"]
    spec = flat(6)
    assert allocation(model, spec).rank == 4
    assert allocation(model, spec).condition == np.inf
    result = hover(model, spec, q)
    assert result.feasible, result.violations
    force = lateral_force_range(model, spec, q)
    assert force.forward == pytest.approx(0.0, abs=1e-6)
    assert not any(np.signbit([force.forward, force.backward, force.left, force.right])), "prints -0"


def test_tilted_base_with_coplanar_rotors_does_not_hover(model: pin.Model) -> None:
    q = np.array(model.referenceConfigurations["home"])
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.2, 0.0, 0.0)).coeffs()
    result = hover(model, flat(6), q)
    assert not result.feasible
    assert "unbalanced" in result.violations[0]
    assert result.residual == pytest.approx(3.02 * 9.81 * np.sin(0.2), rel=0.05)


def test_more_rotors_than_needed_are_spread_away_from_their_limits(model: pin.Model) -> None:
    q = model.referenceConfigurations["home"]
    spec = flat(8)
    result = hover(model, spec, q)
    assert result.feasible
    mean = 3.02 * 9.81 / 8
    assert result.thrust_margin > 0.8 * mean / thrust_limits(spec)[1]


def test_weak_rotors_and_weak_joints_are_named(model: pin.Model, propulsion: PropulsionSpec) -> None:
    q = model.referenceConfigurations["brace_forward"]
    weak = replace(propulsion, speed_max=70.0)
    result = hover(model, weak, q)
    assert result.thrust_margin < 0
    assert any("rotor_1" in v for v in result.violations)
    limp = pin.Model(model)
    effort = limp.effortLimit.copy()
    effort[7] = 0.1
    limp.effortLimit = effort
    result = hover(limp, propulsion, q)
    assert result.torque_margin < 0
    line = r"shoulder_pitch would need \S+ N·m, above its limit 0\.1 N·m"
    assert any(re.fullmatch(line, violation) for violation in result.violations)
    assert lateral_force_range(limp, propulsion, q).forward != lateral_force_range(model, propulsion, q).forward


def test_a_limit_of_zero_is_not_known(model: pin.Model, propulsion: PropulsionSpec) -> None:
    unknown, q = pin.Model(model), model.referenceConfigurations["home"]
    unknown.effortLimit = np.zeros(model.nv)
    held = hover(unknown, propulsion, q)
    assert held.feasible and held.torque_margin == 1
    free, bounded = (lateral_force_range(each, propulsion, q) for each in (unknown, model))
    assert all(getattr(free, side) >= getattr(bounded, side) - 1e-9 > 0 for side in vars(free))


def test_bad_input(model: pin.Model, propulsion: PropulsionSpec) -> None:
    fixed = pin.buildModelFromUrdf(str(FOLDER / "tilthex_arm.urdf"))
    with pytest.raises(SpecError, match="base is fixed"):
        allocation_matrix(fixed, propulsion)
    with pytest.raises(FrameNotFound, match="base_link"):
        allocation_matrix(model, flat(4, frame="base_lnk"))
    with pytest.raises(SpecError, match="not on the base"):
        allocation_matrix(model, flat(4, frame="ee"))
    long = RotorSpec(name="r", position=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 2.0), spin=1)
    with pytest.raises(SpecError, match="length 2"):
        allocation_matrix(model, flat(4, rotors=(long,)))
    with pytest.raises(SpecError, match="no rotors"):
        allocation_matrix(model, flat(4, rotors=()))
    with pytest.raises(SpecError, match="speed_min"):
        thrust_limits(flat(4, speed_min=130.0))
    with pytest.raises(PostureError, match="nq = 10"):
        hover(model, propulsion, np.zeros(3))
    with pytest.raises(PostureError, match="not finite"):
        hover(model, propulsion, np.full(10, np.nan))
    upright = np.array(model.referenceConfigurations["home"])
    upright[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, -np.pi / 2, 0.0)).coeffs()
    with pytest.raises(PostureError, match="vertical"):
        lateral_force_range(model, propulsion, upright)
