"""The hash of a model depends on the data of the dynamics and on no other data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.robot.model_hash import _axis
from impact_posture.robot.robot_loader import load_robot
from tests.robot.test_robot_loader import ARM, spec
from tests.support.helpers import NAMES, robot


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "two.urdf"
    path.write_text(ARM, encoding="utf-8")
    return path


def test_robots_have_different_and_stable_hashes() -> None:
    assert len({robot(name).model_sha256 for name in NAMES}) == len(NAMES)
    assert load_robot("talos").model_sha256 == robot("talos").model_sha256


def test_the_hash_depends_on_the_dynamics(arm: Path) -> None:
    reference = load_robot(str(arm)).model_sha256
    changed = {
        "armature": load_robot(str(arm), LoadOptions(armature={"elbow": 1e-4})),
        "lock": load_robot(str(arm), LoadOptions(lock=("elbow",))),
        "root": load_robot(str(arm), LoadOptions(root="free-flyer")),
    }
    edits = {
        "mass": ('<mass value="1"/>', '<mass value="1.001"/>'),
        "placement": ('<origin xyz="0 0 0.4"/>', '<origin xyz="0 0 0.401"/>'),
        "axis": ('<axis xyz="0 0 1"/>', '<axis xyz="0 1 1"/>'),
        "other axis": ('<axis xyz="0 0 1"/>', '<axis xyz="0 1 2"/>'),
        "inertia": ('izz="0.005"', 'izz="0.006"'),
        "name": ("elbow", "knee"),
    }
    for what, (old, new) in edits.items():
        assert old in ARM
        path = arm.parent / f"{what}.urdf"
        path.write_text(ARM.replace(old, new), encoding="utf-8")
        changed[what] = load_robot(str(path))
    hashes = {what: loaded.model_sha256 for what, loaded in changed.items()}
    assert reference not in hashes.values()
    assert len(set(hashes.values())) == len(hashes), hashes


def test_the_hash_does_not_depend_on_limits_postures_or_comments(arm: Path) -> None:
    reference = load_robot(str(arm)).model_sha256
    text = "[limits.position]\nelbow = [0.6, 1.0]\n[postures.up.joints]\nelbow = 0.7\n"
    assert load_robot(str(arm), LoadOptions(config=spec(arm.parent, text, "x.toml"))).model_sha256 == reference
    arm.write_text(ARM.replace("<link", "<!-- a link --><link"), encoding="utf-8")
    assert load_robot(str(arm)).model_sha256 == reference


def test_the_hash_of_a_joint_does_not_depend_on_its_place_in_a_chain() -> None:
    """The motion subspace of a universal joint depends on its angle, so the configuration matters."""
    joint, none = pin.JointModelUniversal(np.array([1.0, 0, 0]), np.array([0, 1.0, 0])), pin.SE3.Identity()
    alone, chain, parent = pin.Model(), pin.Model(), 0
    for k in range(3000):
        parent = chain.addJoint(parent, pin.JointModelRX(), none, f"joint{k}")
    alone.addJoint(0, joint, none, "last")
    last = chain.addJoint(parent, joint, none, "last")
    np.testing.assert_array_equal(_axis(chain.joints[last]), _axis(alone.joints[1]))
