"""Joints whose place differs from the URDF (``LoadOptions.mounting``, ``mounting`` in scenario.toml)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import ImpactPostureError, InputError, JointNotFound
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.scenario_file import read_scenario
from tests.support.helpers import rng
from tests.support.pinocchio_values import frame_placement, mass_matrix

MOVED = (-0.08, 0.02, 0.01)


@pytest.mark.parametrize(
    ("name", "joint"),
    [("tilthex_arm", "shoulder_roll"), ("panda", "panda_joint4"), ("talos", "arm_left_1_joint")],
)
def test_a_joint_moves_with_its_subtree(name: str, joint: str) -> None:
    plain, moved = load_robot(name), load_robot(name, LoadOptions(mounting={joint: MOVED}))
    step = 0.2 * rng(name, joint).normal(size=plain.nv)
    q = np.array(pin.integrate(plain.model, plain.posture(), step))
    index = plain.model.getJointId(joint)
    data = plain.model.createData()
    pin.forwardKinematics(plain.model, data, q)
    # The mounting vector is in the axes of the preceding joint.
    shift = data.oMi[plain.model.parents[index]].rotation @ np.array(MOVED)
    behind = set(plain.model.subtrees[index])
    assert len(behind) > 1
    for k, frame in enumerate(plain.model.frames):
        a, b = frame_placement(plain.model, q, k), frame_placement(moved.model, q, k)
        np.testing.assert_allclose(b.rotation, a.rotation, atol=1e-12)
        expected = shift if frame.parentJoint in behind else np.zeros(3)
        np.testing.assert_allclose(b.translation - a.translation, expected, atol=1e-12, err_msg=frame.name)


def test_masses_and_inertias_stay_and_the_dynamics_follow() -> None:
    plain = load_robot("tilthex_arm")
    moved = load_robot("tilthex_arm", LoadOptions(mounting={"shoulder_roll": MOVED}))
    assert moved.mass == pytest.approx(plain.mass, rel=1e-15)
    for a, b in zip(plain.model.inertias, moved.model.inertias, strict=True):
        np.testing.assert_array_equal(a.matrix(), b.matrix())
    np.testing.assert_array_equal(plain.armature, moved.armature)
    np.testing.assert_array_equal(plain.model.lowerPositionLimit, moved.model.lowerPositionLimit)
    M, N = (mass_matrix(r.model, plain.posture()) for r in (plain, moved))
    # The inertia of the arm does not depend on its mounting, but the inertial coupling with the base does.
    np.testing.assert_allclose(N[6:, 6:], M[6:, 6:], atol=1e-12)
    assert np.abs(N[:6, :6] - M[:6, :6]).max() > 1e-3


def test_another_mounting_is_another_robot_and_none_is_the_same() -> None:
    shas = [
        load_robot("ur5", LoadOptions(mounting=mounting)).model_sha256
        for mounting in ({}, {"elbow_joint": (0.0, 0.0, 0.0)}, {"elbow_joint": MOVED}, {"elbow_joint": (0, 0, 1e-6)})
    ]
    assert shas[0] == shas[1] == load_robot("ur5").model_sha256
    assert len(set(shas)) == 3


def test_two_joints_at_once() -> None:
    both = load_robot("ur5", LoadOptions(mounting={"elbow_joint": (0.1, 0, 0), "wrist_1_joint": (0, 0, 0.2)}))
    plain = load_robot("ur5")
    for joint, offset in (("elbow_joint", (0.1, 0, 0)), ("wrist_1_joint", (0, 0, 0.2)), ("wrist_2_joint", (0, 0, 0))):
        index = plain.model.getJointId(joint)
        shift = both.model.jointPlacements[index].translation - plain.model.jointPlacements[index].translation
        np.testing.assert_allclose(shift, offset, atol=1e-15)


def test_an_unknown_joint_is_named_with_its_nearest() -> None:
    with pytest.raises(JointNotFound, match=r"did you mean.*elbow_pitch") as caught:
        load_robot("tilthex_arm", LoadOptions(mounting={"elbow_pich": MOVED}))
    assert "\n" not in caught.value.line and "mounting" in caught.value.line


@pytest.mark.parametrize(
    ("offset", "fault"), [((np.nan, 0.0, 0.0), "offset of 'elbow_pitch' is not finite"), ((0.1, 0.2), "three")]
)
def test_a_wrong_offset_is_refused(offset: tuple[float, ...], fault: str) -> None:
    with pytest.raises(InputError, match=fault) as caught:
        load_robot("tilthex_arm", LoadOptions(mounting={"elbow_pitch": offset}))  # type: ignore[dict-item]
    assert "\n" not in caught.value.line


def test_the_floating_base_itself_is_not_mounted() -> None:
    with pytest.raises(ImpactPostureError) as caught:
        load_robot("tilthex_arm", LoadOptions(mounting={"root_joint": MOVED}))
    assert "\n" not in caught.value.line


def test_the_mounting_of_a_scenario_reaches_the_robot(tmp_path: Path) -> None:
    scenario = read_scenario("aerial-vertical")
    assert scenario.mounting == {"shoulder_roll": (-0.08, 0.0, 0.0)}
    text = Path(scenario.source).read_text(encoding="utf-8")
    without = tmp_path / "plain.toml"
    lines = [line for line in text.splitlines() if not line.startswith("mounting")]
    without.write_text("\n".join(lines), encoding="utf-8")
    assert dict(read_scenario(without).mounting) == {}
    mounted, plain = (load_robot(scenario.robot, each) for each in (scenario, replace(scenario, mounting={})))
    assert mounted.model_sha256 != plain.model_sha256


def test_a_mounting_of_two_numbers_in_a_scenario_is_refused(tmp_path: Path) -> None:
    text = Path(read_scenario("aerial-vertical").source).read_text(encoding="utf-8")
    path = tmp_path / "short.toml"
    path.write_text(text.replace("[-0.08, 0.0, 0.0]", "[-0.08, 0.0]"), encoding="utf-8")
    with pytest.raises(ImpactPostureError, match=r"mounting.shoulder_roll") as caught:
        read_scenario(path)
    assert "\n" not in caught.value.line
