"""Load robots by name or by path: files, invalid names, locked joints, armature."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.errors import (
    FrameNotFound,
    InputError,
    JointLocked,
    JointNotFound,
    NameNotFound,
    PackageNotFound,
    PostureNotFound,
    RobotNotFound,
    SpecError,
    UrdfError,
    nearest,
)
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.urdf import example_robot_data
from tests.support.helpers import NAMES, assert_close, contact_frame, random_configurations, robot
from tests.support.pinocchio_values import mass_matrix

UR5 = "example-robot-data:ur_description/urdf/ur5_robot.urdf"

ARM = """<robot name="two">
<link name="base"><inertial><mass value="3"/>
<inertia ixx="0.03" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="upper"><inertial><mass value="2"/><origin xyz="0 0 0.2"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><mass value="1"/><origin xyz="0 0 0.1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="10" velocity="3"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit lower="0.5" upper="2" effort="5" velocity="3"/></joint>
<joint name="wheel_mount" type="continuous"><parent link="lower"/><child link="wheel"/><origin xyz="0 0 0.3"/>
<axis xyz="0 0 1"/></joint>
<link name="wheel"><inertial><mass value="0.3"/>
<inertia ixx="0.001" iyy="0.001" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
SRDF = """<robot name="two"><group_state name="folded" group="all"><joint name="shoulder" value="1"/>
<joint name="elbow" value="1.5"/></group_state>
<rotor_params><joint name="shoulder" mass="0.0001" gear_ratio="100"/>
<joint name="elbow" mass="0.00005" gear_ratio="50"/></rotor_params></robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "two.urdf"
    path.write_text(ARM, encoding="utf-8")
    return path


def spec(folder: Path, text: str, name: str = "robot.toml") -> str:
    path = folder / name
    path.write_text(f'schema = "impact-posture/robot/1"\n{text}', encoding="utf-8")
    return str(path)


# ---- files ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_known_robot_loads(name: str) -> None:
    loaded = robot(name)
    assert loaded.name == name
    assert loaded.default_posture in loaded.postures
    for posture, q in loaded.postures.items():
        assert q.shape == (loaded.nq,)
        np.testing.assert_allclose(pin.normalize(loaded.model, q), q, atol=1e-12, err_msg=posture)
    checked = loaded.check_posture(loaded.posture())
    np.testing.assert_array_equal(checked, loaded.posture())
    assert len(set(loaded.tangent_names)) == len(loaded.tangent_names) == loaded.nv
    assert loaded.armature.shape == (loaded.nv,)
    assert not loaded.armature[: 6 * loaded.floating].any()
    assert loaded.mass > 0.5
    assert loaded.floating == (loaded.model.joints[1].shortname() == "JointModelFreeFlyer")
    assert len(loaded.joint_names) == loaded.model.njoints - 1 - loaded.floating
    assert loaded.source.startswith(("example-robot-data:", "impact-posture:"))


def test_a_robot_without_a_robot_toml_loads_by_path() -> None:
    loaded = load_robot(UR5)
    assert loaded.source == UR5
    assert loaded.root == "fixed"
    assert loaded.default_posture == "neutral"
    floating = load_robot(str(example_robot_data() / UR5.partition(":")[2]), LoadOptions(root="free-flyer"))
    assert floating.nv == loaded.nv + 6
    assert floating.joint_names == loaded.joint_names
    assert floating.tangent_names[:6] == ("base vx", "base vy", "base vz", "base wx", "base wy", "base wz")


def test_every_other_robot_of_example_robot_data_loads_or_says_why_not() -> None:
    refused = {}
    paths = sorted(example_robot_data().rglob("*.urdf"))
    for path in paths:
        try:
            loaded = load_robot(f"example-robot-data:{path.relative_to(example_robot_data()).as_posix()}")
        except UrdfError as error:
            refused[path.name] = error
            assert "\n" not in error.line
            assert error.hint
        else:
            assert np.isfinite(mass_matrix(loaded.model, loaded.posture())).all()
    # The axis of the neck passes through a point mass, so neck_roll and neck_yaw are the same motion there.
    assert "neck_roll" in refused.pop("icub.urdf").line
    assert len(refused) < len(paths) / 5


def test_no_mesh_is_needed(arm: Path) -> None:
    geometry = '<visual><geometry><mesh filename="package://nowhere/of.stl"/></geometry></visual>'
    arm.write_text(ARM.replace('<link name="lower">', f'<link name="lower">{geometry}'), encoding="utf-8")
    assert load_robot(str(arm)).nv == 3


def test_neutral_moves_into_the_limits(arm: Path) -> None:
    loaded = load_robot(str(arm))
    np.testing.assert_allclose(loaded.posture(), [0.0, 0.5, 1.0, 0.0])
    loaded.check_posture(loaded.posture())


def test_a_robot_toml_beside_the_urdf_is_read(arm: Path) -> None:
    spec(
        arm.parent,
        'name = "mine"\ndefault_posture = "up"\n[postures.up.joints]\nelbow = 1.0\nwheel_mount = 0.5\n'
        '[limits.position]\nshoulder = [-1.0, 1.0]\n[limits.velocity]\nelbow = 7.0\n[limits.effort]\nelbow = 9.0\n',
    )  # fmt: skip
    loaded = load_robot(str(arm))
    assert loaded.name == "mine"
    np.testing.assert_allclose(loaded.posture(), [0.0, 1.0, np.cos(0.5), np.sin(0.5)])
    assert loaded.model.upperPositionLimit[0] == 1.0
    assert loaded.model.lowerPositionLimit[0] == -1.0
    assert loaded.model.upperVelocityLimit[1] == 7.0
    assert loaded.model.upperEffortLimit[1] == 9.0
    other = spec(arm.parent, 'name = "other"', "other.toml")
    assert load_robot(str(arm), LoadOptions(config=other)).name == "other"


def test_config_paths_start_from_the_config(arm: Path, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "two.srdf").write_text(SRDF, encoding="utf-8")
    config = spec(folder, 'name = "panda2"\n[model]\nurdf = "../two.urdf"\nsrdf = "two.srdf"')
    for named in (str(arm), "panda"):
        loaded = load_robot(named, LoadOptions(config=config))
        assert loaded.name == "panda2"
        assert loaded.joint_names == ("shoulder", "elbow", "wheel_mount")
        np.testing.assert_allclose(loaded.posture("folded")[:2], [1.0, 1.5])


def test_config_without_urdf_keeps_the_known_robots_own(tmp_path: Path) -> None:
    loaded = load_robot("ur5", LoadOptions(config=spec(tmp_path, 'name = "ours"')))
    assert loaded.name == "ours"
    assert loaded.joint_names == robot("ur5").joint_names


def test_srdf_by_option(arm: Path) -> None:
    path = arm.with_suffix(".srdf")
    path.write_text(SRDF, encoding="utf-8")
    loaded = load_robot(str(arm), LoadOptions(srdf=str(path)))
    np.testing.assert_allclose(loaded.posture("folded")[:2], [1.0, 1.5])
    with pytest.raises(UrdfError, match="no such file"):
        load_robot(str(arm), LoadOptions(srdf=str(path) + "x"))


def test_the_root_can_be_fixed_or_floating() -> None:
    loaded = load_robot("solo8", LoadOptions(root="fixed"))
    assert loaded.nv == 8
    np.testing.assert_allclose(loaded.posture(), robot("solo8").posture()[7:])
    flying = load_robot("panda", LoadOptions(root="free-flyer"))
    np.testing.assert_allclose(flying.posture()[7:], robot("panda").posture())
    np.testing.assert_allclose(flying.posture()[:7], [0, 0, 0, 0, 0, 0, 1])


# ---- wrong names ------------------------------------------------------------------------------------------------


def test_wrong_robot_names_get_the_nearest() -> None:
    for wrong, right in (("solo-8", "solo8"), ("Talos", "talos"), ("pnada", "panda"), ("tilthex", "tilthex_arm")):
        with pytest.raises(RobotNotFound) as caught:
            load_robot(wrong)
        assert caught.value.nearest[0] == right
        assert right in caught.value.line
        assert "\n" not in caught.value.line
        assert caught.value.exit_code == 1


def test_wrong_names_inside_a_robot() -> None:
    loaded = robot("panda")
    cases = [
        (FrameNotFound, lambda: loaded.frame_id("panda_hnd"), "panda_hand"),
        (JointNotFound, lambda: loaded.joint_id("panda_jiont3"), "panda_joint3"),
        (PostureNotFound, lambda: loaded.posture("defualt"), "default"),
    ]
    for error, call, right in cases:
        with pytest.raises(error) as caught:
            call()
        assert isinstance(caught.value, NameNotFound)
        assert right in caught.value.nearest
        assert "panda" in caught.value.where
        assert "\n" not in str(caught.value)
    with pytest.raises(FrameNotFound):
        loaded.frame_id("universe")
    with pytest.raises(JointNotFound):
        robot("solo8").joint_id("root_joint")


def test_a_locked_joint_is_said_to_be_locked() -> None:
    loaded = load_robot("panda", LoadOptions(lock=("panda_joint1",)))
    with pytest.raises(JointLocked, match="joint 'panda_joint1' is locked"):
        loaded.joint_id("panda_joint1")


def test_wrong_paths_get_the_nearest(arm: Path) -> None:
    with pytest.raises(PackageNotFound) as caught:
        load_robot("example-robot-data:ur_description/urdf/ur5_robt.urdf")
    assert "ur_description/urdf/ur5_robot.urdf" in caught.value.nearest
    (arm.parent / "meshes").mkdir()
    for wrong in (arm.parent / "meshs", Path("no/such/folder")):
        with pytest.raises(PackageNotFound, match="package_dir"):
            load_robot(str(arm), LoadOptions(package_dir=(str(wrong),)))
    with pytest.raises(PackageNotFound) as caught:
        load_robot(str(arm), LoadOptions(package_dir=(str(arm.parent / "meshs"),)))
    assert str(arm.parent / "meshes") in caught.value.nearest
    load_robot("panda", LoadOptions(package_dir=(str(arm.parent / "meshes"),)))


def test_package_dirs_start_from_where_the_user_stands(arm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (arm.parent / "meshes").mkdir()
    monkeypatch.chdir(arm.parent)
    assert load_robot("ur5", LoadOptions(package_dir=("meshes",))).nv == 6


def test_wrong_joints_in_options_and_specs(arm: Path) -> None:
    for options in (LoadOptions(lock=("elbw",)), LoadOptions(armature={"elbw": 0.1})):
        with pytest.raises(JointNotFound) as caught:
            load_robot(str(arm), options)
        assert caught.value.nearest[0] == "elbow"
    for text in (
        "[postures.up.joints]\nelbw = 1.0", "[limits.position]\nelbw = [0.0, 1.0]", "[limits.effort]\nelbw = 1.0",
        "[armature.joints]\nelbw = 0.1", '[model]\nlock = ["elbw"]',
    ):  # fmt: skip
        with pytest.raises(JointNotFound) as caught:
            load_robot(str(arm), LoadOptions(config=spec(arm.parent, text, "wrong.toml")))
        assert caught.value.nearest[0] == "elbow"


def test_nearest_prefers_close_then_contained_then_any() -> None:
    known = ["left_wrist_roll_joint", "elbow", "knee"]
    assert nearest("ELBOW", known) == ["elbow"]
    assert nearest("wrist", known) == ["left_wrist_roll_joint"]
    assert nearest("zzz", known) == known


# ---- locking ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "lock"), [("talos", ("torso_1_joint", "torso_2_joint")), ("panda", ("panda_joint3",))]
)
def test_locking_reduces(name: str, lock: tuple[str, ...]) -> None:
    """Locked joints give the same H as joints with an extremely large armature."""
    whole, locked = robot(name), load_robot(name, LoadOptions(lock=lock))
    assert locked.nv == whole.nv - len(lock)
    assert set(lock) <= set(locked.locked)
    assert set(locked.postures) == set(whole.postures)
    assert not set(lock) & set(locked.joint_names)
    ids = [whole.joint_id(joint) for joint in lock]
    dropped_v = [int(whole.model.idx_vs[i]) for i in ids]
    kept = [k for k in range(whole.nv) if k not in dropped_v]
    np.testing.assert_array_equal(locked.armature, whole.armature[kept])
    assert locked.mass == pytest.approx(whole.mass, rel=1e-12)
    q = whole.posture()
    q_locked = locked.posture()
    np.testing.assert_allclose(q_locked, np.delete(q, [int(whole.model.idx_qs[i]) for i in ids]))
    np.testing.assert_array_equal(locked.model.upperPositionLimit, np.delete(
        whole.model.upperPositionLimit, [int(whole.model.idx_qs[i]) for i in ids]
    ))  # fmt: skip
    contact = ImpactContact(contact_frame(whole), (0.3, -0.5, 0.8))
    resisting = load_robot(name, LoadOptions(armature=dict.fromkeys(lock, 1e9)))
    reduced = ImpactOracle(ImpactCase(locked, contact)).quantities(q_locked)
    expected = ImpactOracle(ImpactCase(resisting, contact)).quantities(q)
    assert_close(reduced.H, expected.H, 1e-6, "H")
    assert_close(reduced.G, expected.G, 1e-6, "G")
    assert_close(reduced.jump, expected.jump[kept], 1e-6, "jump")
    assert np.abs(expected.jump[dropped_v]).max() < 1e-8
    free = ImpactOracle(ImpactCase(whole, contact)).quantities(q)
    assert free.G > reduced.G


def test_locking_twice_and_locking_all(arm: Path) -> None:
    once = load_robot(str(arm), LoadOptions(lock=("elbow", "elbow")))
    assert once.nv == 2
    assert once.locked == ("elbow",)
    with pytest.raises(InputError, match="every joint is locked"):
        load_robot(str(arm), LoadOptions(lock=("elbow", "shoulder", "wheel_mount")))


def test_locked_joints_stay_where_the_default_posture_has_them(arm: Path) -> None:
    text = 'default_posture = "bent"\n[postures.bent.joints]\nelbow = 1.2\n[model]\nlock = ["elbow"]'
    locked = load_robot(str(arm), LoadOptions(config=spec(arm.parent, text, "bent.toml")))
    whole = load_robot(str(arm))
    data, reduced = whole.model.createData(), locked.model.createData()
    pin.framesForwardKinematics(whole.model, data, np.array([0.3, 1.2, 1.0, 0.0]))
    pin.framesForwardKinematics(locked.model, reduced, np.array([0.3, 1.0, 0.0]))
    one, other = data.oMf[whole.frame_id("wheel")], reduced.oMf[locked.frame_id("wheel")]
    np.testing.assert_allclose(one.homogeneous, other.homogeneous, atol=1e-14)


# ---- armature ---------------------------------------------------------------------------------------------------


def test_armature_order(arm: Path) -> None:
    """Sources of the armature by priority: the option, robot.toml, rotors in the SRDF, and zero with a warning."""
    (arm.parent / "two.srdf").write_text(SRDF, encoding="utf-8")

    def load(text: str, option: dict[str, float] | str | None = None) -> tuple[list[float], str, bool]:
        config = spec(arm.parent, text, "case.toml")
        loaded = load_robot(str(arm), LoadOptions(config=config, armature=option))
        warned = any("armature is zero" in warning for warning in loaded.warnings)
        np.testing.assert_array_equal(loaded.armature, loaded.model.armature)
        return [float(v) for v in loaded.armature], loaded.armature_source, warned

    srdf = '[model]\nsrdf = "two.srdf"\n'
    ours = '[armature]\ndefault = 0.02\nsource = "a data sheet"\n[armature.joints]\nelbow = 0.03\n'
    assert load("") == ([0.0, 0.0, 0.0], "none", True)
    values, source, warned = load(srdf)
    np.testing.assert_allclose(values, [1.0, 0.125, 0.0])
    assert (source, warned) == ("rotor data in the SRDF", True)
    assert load(srdf + ours) == ([0.02, 0.03, 0.02], "robot.toml (a data sheet)", False)
    values, source, _ = load(srdf + ours, {"elbow": 0.5})
    assert values == [0.02, 0.5, 0.02] and source.startswith("given values over robot.toml")
    values, source, warned = load(srdf + ours, "none")
    assert (values, warned) == ([0.0, 0.0, 0.0], True)
    file = arm.parent / "armature.toml"
    file.write_text("shoulder = 0.7\n", encoding="utf-8")
    assert load(srdf + ours, str(file)) == ([0.7, 0.0, 0.0], str(file), True)


def test_armature_adds_to_the_mass_matrix(arm: Path) -> None:
    plain, geared = load_robot(str(arm)), load_robot(str(arm), LoadOptions(armature={"elbow": 0.25}))
    (q,) = random_configurations(plain.model, 1, "armature")
    added = mass_matrix(geared.model, q) - mass_matrix(plain.model, q)
    np.testing.assert_allclose(added, np.diag([0.0, 0.25, 0.0]), atol=1e-14)


def test_the_srdf_of_talos_has_rotors() -> None:
    talos = robot("talos")
    assert talos.armature_source == "rotor data in the SRDF"
    assert np.median(talos.armature[6:]) == pytest.approx(0.1, rel=1.0)
    assert (talos.armature[:6] == 0).all()


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_impossible_armature_is_refused(arm: Path, value: float) -> None:
    with pytest.raises(InputError, match="elbow"):
        load_robot(str(arm), LoadOptions(armature={"elbow": value}))
    config = spec(arm.parent, f"[armature.joints]\nelbow = {value}", "wrong.toml")
    with pytest.raises(SpecError, match="elbow"):
        load_robot(str(arm), LoadOptions(config=config))
    file = arm.parent / "armature.toml"
    file.write_text(f"elbow = {value}\n", encoding="utf-8")
    with pytest.raises(SpecError, match="elbow"):
        load_robot(str(arm), LoadOptions(armature=str(file)))


def test_an_armature_file_without_numbers_is_refused(arm: Path) -> None:
    file = arm.parent / "armature.toml"
    file.write_text('elbow = "much"\n', encoding="utf-8")
    with pytest.raises(SpecError, match="joint = value"):
        load_robot(str(arm), LoadOptions(armature=str(file)))
    with pytest.raises(SpecError, match="no such file"):
        load_robot(str(arm), LoadOptions(armature=str(file) + "x"))


def test_a_robot_prints_in_one_line() -> None:
    """The representation of a robot is short, because model and data file are left out."""
    robot = load_robot("panda")
    assert repr(robot).startswith("Robot('panda', root='fixed', nq=9, nv=9, source=") and "\n" not in repr(robot)
