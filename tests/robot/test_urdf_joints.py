"""Joint types and attributes of a URDF that the parser of Pinocchio reads wrongly or drops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.errors import UrdfError
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.actuation import torque_limits
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_summary import summarize
from tests.support.command import run
from tests.support.helpers import assert_close
from tests.support.urdfs import joint, link, load

ARM = (
    link("stand", 5),
    link("cart", 3, "0 0 0.05"),
    link("arm", 1, "0.2 0 0"),
    link("tip"),
    joint("a", "cart arm", at="0 0 0.1"),
    joint("tip_mount", "arm tip", None, at="0.4 0 0", kind="fixed", more=""),
)


def metric(robot: Robot, q: np.ndarray, normal: tuple[float, float, float] = (0.6, 0.0, 0.8)) -> float:
    return ImpactOracle(ImpactCase(robot, ImpactContact("tip", normal))).quantities(q).H


def normal_to_plane(folder: Path, axis: str) -> Robot:
    return load(folder, *ARM, joint("slide", "stand cart", axis, "0 0 0.3", "planar", ""))


@pytest.mark.parametrize(("axis", "one", "two"), [("0 1 0", "1 0 0", "0 0 1"), ("0 0 -1", "1 0 0", "0 1 0")])
def test_a_planar_joint_moves_in_the_plane_normal_to_its_axis(tmp_path: Path, axis: str, one: str, two: str) -> None:
    """Two sliding joints and a revolute joint are the reference; Pinocchio itself ignores the axis."""
    planar = normal_to_plane(tmp_path, axis)
    chain = load(
        tmp_path, *ARM, link("u"), link("w"), joint("one", "stand u", one, "0 0 0.3", "prismatic"),
        joint("two", "u w", two, kind="prismatic"), joint("turn", "w cart", axis),
    )  # fmt: skip
    random = np.random.default_rng(0)
    for _ in range(5):
        q = pin.integrate(planar.model, planar.posture(), random.uniform(-1, 1, planar.nv))
        data = planar.model.createData()
        pin.framesForwardKinematics(planar.model, data, q)
        cart, tip = (data.oMf[planar.frame_id(name)] for name in ("cart", "tip"))
        at = cart.translation - np.array([0, 0, 0.3])
        slides = [np.array([float(v) for v in text.split()]) @ at for text in (one, two)]
        along = np.array([float(v) for v in axis.split()])
        same = np.array([*slides, float(pin.log3(cart.rotation) @ along), q[-1]])
        pin.framesForwardKinematics(chain.model, (other := chain.model.createData()), same)
        assert_close(tip.homogeneous, other.oMf[chain.frame_id("tip")].homogeneous, 1e-12, "tip")
        assert metric(planar, q) == pytest.approx(metric(chain, same), rel=1e-10)


def test_a_planar_joint_without_axis_is_a_warning(tmp_path: Path) -> None:
    robot = load(tmp_path, *ARM, joint("slide", "stand cart", None, "0 0 0.3", "planar", ""))
    assert [line for line in robot.warnings if "planar joint 'slide' has no <axis>" in line]
    assert metric(robot, robot.posture()) == metric(normal_to_plane(tmp_path, "0 0 1"), robot.posture())


def test_an_axis_counts_by_its_direction_and_a_zero_axis_is_refused(tmp_path: Path) -> None:
    def turning(axis: str | None, kind: str = "revolute") -> Robot:
        return load(tmp_path, *ARM, joint("b", "stand cart", axis, kind=kind))

    q = np.array([0.3, 0.4])
    assert metric(turning("0 3 0"), q) == pytest.approx(metric(turning("0 1 0"), q), rel=1e-12)
    assert metric(turning(None), q) == metric(turning("1 0 0"), q)
    for kind in ("revolute", "prismatic", "continuous", "planar"):
        with pytest.raises(UrdfError, match="the axis of joint 'b' is zero"):
            turning("0 0 0", kind)


def test_limits_of_a_continuous_joint_are_a_warning_if_they_are_less_than_a_turn(tmp_path: Path) -> None:
    for low, high, warned in ((-1, 1, True), (-3.1416, 3.1416, False), (0, 0, False), (-1e16, 1e16, False)):
        limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
        robot = load(tmp_path, *ARM, joint("b", "stand cart", kind="continuous", more=limit))
        assert any("'b' is continuous, so its position limits [-1, 1]" in line for line in robot.warnings) == warned


def test_a_type_that_urdf_lacks_is_refused_by_the_name_of_its_joint(tmp_path: Path) -> None:
    for kind in ("Revolute", "ball", "screw"):
        with pytest.raises(UrdfError, match=rf"Joint \[b\] has no known type \[{kind}\]"):
            load(tmp_path, *ARM, joint("b", "stand cart", kind=kind))


def test_negative_limits_of_effort_and_velocity_are_not_known(tmp_path: Path) -> None:
    unlimited = '<limit lower="-2.5" upper="2.5" effort="-1" velocity="-1.0"/>'
    tree = (link("s", 5), link("u", 2, "0.2 0 0"), link("f", 1, "0.2 0 0"), joint("b", "u f"))
    robot = load(tmp_path, *tree, joint("a", "s u", more=unlimited))
    efforts = "negative effort limits are read as not known: a (-1); state them in robot.toml [limits.effort]"
    assert efforts in robot.warnings and any(
        "velocity limits" in line and "a (-1.0)" in line for line in robot.warnings
    )
    assert torque_limits(robot.model).tolist() == [np.inf, 100] and robot.velocity_limits.tolist() == [np.inf, 5]
    assert [entry["effort"] for entry in summarize(robot)["joints"]] == [None, 100]
    stated = load(tmp_path, *tree, joint("a", "s u", more=unlimited), toml="[limits.effort]\na = 50")
    assert torque_limits(stated.model).tolist() == [50, 100]


def test_position_limits_that_are_not_stated(tmp_path: Path) -> None:
    tree = (link("s", 5), link("u", 2, "0.2 0 0"), link("f", 1, "0.2 0 0"), joint("b", "u f"))
    bare = joint("a", "s u", more='<limit effort="10" velocity="1"/>')
    line = "joints with equal position limits are held at them: a"
    assert any(line in warning for warning in load(tmp_path, *tree, bare).warnings)
    done = run("inspect", tmp_path / "written.urdf")
    assert next(row for row in done.stdout.splitlines() if row.startswith("a ")).split() == (
        ["a", "revolute", "not", "stated", "1", "10", "0"]
    )
    stated = load(tmp_path, *tree, bare, toml="[limits.position]\na = [-1, 1]")
    assert not any(line in warning for warning in stated.warnings)
