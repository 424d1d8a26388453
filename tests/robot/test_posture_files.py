"""Postures by name and by file: written postures are read back, and each fault gives one line with a hint."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import (
    ImpactPostureError,
    JointLocked,
    JointNotFound,
    NotWithinLimits,
    PostureError,
    PostureNotFound,
)
from impact_posture.robot.posture_files import posture_path, read_posture, write_posture
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from tests.support.helpers import NAMES, random_configurations, rng, robot
from tests.support.urdfs import joint, link, load


def save(path: Path, data: object) -> str:
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return str(path)


def inside_limits(loaded: Robot) -> np.ndarray:
    """Return a random posture with every joint within its limits."""
    (q,) = random_configurations(loaded.model, 1, "posture", loaded.name)
    start = 7 if loaded.floating else 0
    low, high = np.array(loaded.model.lowerPositionLimit), np.array(loaded.model.upperPositionLimit)
    for k in range(start, loaded.nq):
        if low[k] < high[k] and high[k] - low[k] < 100 and not low[k] <= q[k] <= high[k]:
            q[k] = rng(loaded.name, k).uniform(low[k], high[k])
    return loaded.check_posture(loaded.coupled(q))


@pytest.mark.parametrize("name", NAMES)
def test_a_written_posture_is_read_back(name: str, tmp_path: Path) -> None:
    loaded = robot(name)
    q = inside_limits(loaded)
    path = save(tmp_path / "posture.json", write_posture(loaded, q))
    # Reading normalizes quaternions and angles again, so their last digit may change.
    assert np.allclose(read_posture(loaded, path), q, rtol=0, atol=1e-15)


def test_posture_json_names_the_entries_of_q_and_gives_one_angle_per_joint(tmp_path: Path) -> None:
    ends = [joint("a", "s u", kind="continuous", more=""), joint("b", "u f"), joint("c", "f t", kind="continuous")]
    loaded = load(tmp_path, *(link(name, 1, "0.1 0 0") for name in "suft"), *ends)
    path = save(tmp_path / "by_name.json", {"joints": {"a": 2.0, "b": -0.5, "c": -3.0}})
    q = read_posture(loaded, path)
    content = write_posture(loaded, q)
    assert content["q_names"] == ["a cos", "a sin", "b (rad)", "c cos", "c sin"]
    assert content["joints"] == pytest.approx({"a": 2.0, "b": -0.5, "c": -3.0}, abs=1e-15)
    assert np.allclose(read_posture(loaded, save(tmp_path / "both.json", content)), q, rtol=0, atol=1e-15)
    # A user may edit the angle in ``joints``, but then ``q`` must not contain another value of this angle.
    content["joints"] = {**content["joints"], "a": 1.0}  # type: ignore[dict-item]
    with pytest.raises(PostureError, match=r"a cos is -0.416147 in q, but 0.540302 under its name; remove either q"):
        read_posture(loaded, save(tmp_path / "edited.json", content))
    del content["q"]
    assert read_posture(loaded, save(tmp_path / "edited.json", content))[0] == np.cos(1.0)
    # A continuous joint has no limits, so that 90 degrees would silently be 90 radians.
    with pytest.raises(PostureError, match=r"joint 'a' is at 90; degrees\? .* 90° are 1.5708"):
        read_posture(loaded, save(tmp_path / "degrees.json", {"joints": {"a": 90}}))


def test_posture_json_has_the_documented_keys() -> None:
    loaded = robot("tilthex_arm")
    content = write_posture(loaded, loaded.posture())
    assert content["schema"] == "impact-posture/posture/1"
    assert content["robot"] == "tilthex_arm"
    assert content["joint_names"] == ["shoulder_roll", "shoulder_pitch", "elbow_pitch"]
    assert content["q"] == loaded.posture().tolist()


def test_a_name_and_the_default() -> None:
    loaded = robot("tilthex_arm")
    assert np.array_equal(read_posture(loaded, "tucked"), loaded.posture("tucked"))
    assert np.array_equal(read_posture(loaded, None), loaded.posture("home"))
    with pytest.raises(PostureNotFound, match="did you mean tucked") as caught:
        read_posture(loaded, "tuked")
    assert caught.value.where == "posture"


def test_a_file_is_distinguished_from_a_name(tmp_path: Path) -> None:
    assert posture_path("home") is None
    assert posture_path("nowhere.json") == Path("nowhere.json")
    plain = tmp_path / "plain"
    plain.write_text("{}")
    assert posture_path(str(plain)) == plain


def test_joints_by_name(tmp_path: Path) -> None:
    loaded = robot("tilthex_arm")
    base = [1.0, 2.0, 3.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    path = save(tmp_path / "p.json", {"base": base, "joints": {"elbow_pitch": 0.25}})
    expected = loaded.posture()
    expected[:7] = base
    expected[9] = 0.25
    assert np.allclose(read_posture(loaded, path), expected, atol=1e-15)


def test_a_joint_state_keeps_base_and_unnamed_joints(tmp_path: Path) -> None:
    loaded = robot("tilthex_arm")
    # This is the format of `ros2 topic echo`, with its separator.  YAML 1.1 reads the number with an exponent as
    # text.
    text = (
        "header:\n  frame_id: ''\nname:\n- elbow_pitch\n- shoulder_roll\nposition:\n- 0.5\n- 1e-3\n"
        "velocity: []\neffort: []\n---\n"
    )
    q = read_posture(loaded, save(tmp_path / "state.yaml", text))
    expected = loaded.posture()
    expected[9], expected[7] = 0.5, 1e-3
    assert np.allclose(q, expected, atol=1e-15)


def test_a_continuous_joint_is_given_as_an_angle(tmp_path: Path) -> None:
    loaded = robot("kinova")
    index = loaded.joint_id("j2s6s200_joint_1")
    assert loaded.model.nqs[index] == 2
    q = read_posture(loaded, save(tmp_path / "p.json", {"joints": {"j2s6s200_joint_1": 2.0}}))
    first = loaded.model.idx_qs[index]
    assert np.allclose(q[first : first + 2], [np.cos(2.0), np.sin(2.0)], atol=1e-15)


def test_a_message_may_name_locked_joints(tmp_path: Path) -> None:
    loaded = load_robot("tilthex_arm", LoadOptions(lock=("elbow_pitch",)))
    text = "name: [elbow_pitch, shoulder_pitch]\nposition: [0.5, 0.3]\n"
    q = read_posture(loaded, save(tmp_path / "s.yaml", text))
    assert q.shape == (9,)
    assert q[8] == 0.3


def test_a_posture_in_order_may_not_name_locked_joints(tmp_path: Path) -> None:
    (tmp_path / "q.json").write_text(json.dumps(write_posture(load_robot("ur5"), load_robot("ur5").posture())))
    locked = load_robot("ur5", LoadOptions(lock=("elbow_joint",)))
    with pytest.raises(JointLocked, match="joint 'elbow_joint' is locked"):
        read_posture(locked, str(tmp_path / "q.json"))


HOME = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
JOINTS = ["shoulder_roll", "shoulder_pitch", "elbow_pitch"]

FAULTS: list[tuple[str, object, type[ImpactPostureError], str]] = [
    ("unknown.json", {"joints": {"elbow": 0.1}}, JointNotFound, "did you mean elbow_pitch"),
    ("unknown.yaml", "name: [wrist]\nposition: [1.0]\n", JointNotFound, "no joint 'wrist'"),
    ("names.json", {"joint_names": [*JOINTS[:2], "elbow"], "q": HOME}, JointNotFound, "elbow_pitch"),
    ("fewer.json", {"joint_names": JOINTS[:2], "q": HOME}, PostureError, "leaves out joint 'elbow_pitch'"),
    ("order.json", {"joint_names": JOINTS[::-1], "q": HOME}, PostureError, "in another order"),
    ("mismatch.yaml", "name: [elbow_pitch]\nposition: [1.0, 2.0]\n", PostureError, "1 names but 2 positions"),
    ("twice.yaml", "name: [elbow_pitch, elbow_pitch]\nposition: [1, 2]\n", PostureError, "twice"),
    ("nan.yaml", "name: [elbow_pitch]\nposition: [.nan]\n", PostureError, "'elbow_pitch' is not finite"),
    ("nan.json", '{"q": [0, 0, 1, 0, 0, 0, 1, 0, NaN, 0]}', PostureError, "entry 8 is not finite"),
    ("short.json", {"q": HOME[:-1]}, PostureError, "has 10 numbers, this one 9"),
    ("text.json", {"q": [*HOME[:-1], "much"]}, PostureError, "'q' entry 9 is 'much', not a number"),
    ("truth.json", {"q": [*HOME[:-1], True]}, PostureError, "not a number"),
    ("limits.json", {"joints": {"elbow_pitch": 3.0}}, NotWithinLimits, "; choose a posture within the limits"),
    ("degrees.json", {"joints": {"elbow_pitch": 90}}, NotWithinLimits, "90° are 1.5708"),
    ("swapped.json", {"base": [0, 0, 1, 1, 0, 0, 0], "joints": {}}, PostureError, "looks like w x y z"),
    ("norm.json", {"base": [0, 0, 1, 0, 0, 0, 2], "joints": {}}, PostureError, "norm 2"),
    ("base.json", {"base": [0, 0, 1], "joints": {}}, PostureError, "'base' has 3 numbers"),
    ("key.json", {"joint": {}, "q": HOME}, PostureError, "unknown key 'joint'; did you mean joints, joint_names"),
    ("schema.json", {"schema": "impact-posture/result/1", "q": HOME}, PostureError, "is not a posture"),
    ("broken.json", "{", PostureError, "is not valid JSON"),
    ("broken.yaml", "name: [", PostureError, "is not valid YAML"),
    ("list.json", [1, 2], PostureError, "holds no posture"),
    ("empty.yaml", "", PostureError, "holds no posture"),
    ("other.yaml", "velocity: [1]\n", PostureError, "holds no posture"),
]


@pytest.mark.parametrize(("file", "content", "error", "words"), FAULTS, ids=[f[0] for f in FAULTS])
def test_faults_are_one_line(
    file: str, content: object, error: type[ImpactPostureError], words: str, tmp_path: Path
) -> None:
    path = save(tmp_path / file, content)
    with pytest.raises(error) as caught:
        read_posture(robot("tilthex_arm"), path)
    assert words in caught.value.line
    assert "\n" not in caught.value.line
    assert caught.value.where == path
    assert caught.value.exit_code == 1


def test_a_missing_file_a_folder_and_binary(tmp_path: Path) -> None:
    loaded = robot("tilthex_arm")
    with pytest.raises(PostureError, match="no such file"):
        read_posture(loaded, str(tmp_path / "none.json"))
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(PostureError, match="cannot be read"):
        read_posture(loaded, str(tmp_path / "folder.json"))
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(PostureError, match="is not valid JSON"):
        read_posture(loaded, str(tmp_path / "binary.json"))


def test_a_base_pose_needs_a_base(tmp_path: Path) -> None:
    path = save(tmp_path / "p.json", {"base": [0, 0, 0, 0, 0, 0, 1], "joints": {}})
    with pytest.raises(PostureError, match="the root is fixed"):
        read_posture(robot("ur5"), path)
