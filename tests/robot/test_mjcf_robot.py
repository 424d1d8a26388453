"""Robots from MJCF: the same dynamics as in MuJoCo, its limits and keyframes, and what is refused."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.collision.coal_geometry import load_geometry, read_shapes
from impact_posture.collision.shape_corners import shape_points
from impact_posture.collision.shape_pairs import disabled_links
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.draft.draft import write_draft
from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.dynamics.mjcf_layout import file_layout
from impact_posture.errors import InputError, MjcfError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.verification.verification import verify
from tests.support.helpers import rng
from tests.support.helpers import robot as known_robot
from tests.support.mjcfs import ALL, ARM, MESH, ODD, QUADRUPED
from tests.support.pinocchio_values import frame_placement, mass_matrix

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")


def written(folder: Path, text: str, name: str = "robot.xml") -> str:
    path = folder / name
    path.write_text(text)
    return str(path)


def loaded(folder: Path, text: str, **options: Any) -> Robot:
    return load_robot(written(folder, text), **options)


def own(text: str) -> Any:
    return mujoco.MjModel.from_xml_string(text)


def configurations(robot: Robot, count: int = 12) -> list[Any]:
    random = rng(3)
    return [pin.integrate(robot.model, robot.posture(), random.uniform(-2, 2, robot.nv)) for _ in range(count)]


@pytest.mark.parametrize("name", ALL)
def test_mass_matrix_and_frames_are_those_of_mujoco(tmp_path: Path, name: str) -> None:
    robot, model = loaded(tmp_path, ALL[name]), own(ALL[name])
    layout, data = file_layout(robot.model), mujoco.MjData(model)
    for q in configurations(robot):
        data.qpos[:] = layout.qpos(q)
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        T = layout.velocity_map(q)
        expected = T.T @ M @ T
        assert np.abs(mass_matrix(robot.model, q) - expected).max() < 1e-12 * np.abs(expected).max()
        placed = robot.model.createData()
        pin.framesForwardKinematics(robot.model, placed, q)
        for frame, at in zip(robot.model.frames, placed.oMf, strict=True):
            if frame.type == pin.FrameType.OP_FRAME:
                there = data.site(frame.name)
            elif (
                frame.type == pin.FrameType.BODY
                and mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame.name) > 0
            ):
                there = data.body(frame.name)
            else:
                continue
            assert np.allclose(at.translation, there.xpos, atol=1e-13)
            assert np.allclose(at.rotation.ravel(), there.xmat, atol=1e-13)


@pytest.mark.parametrize("name", ["panda", "tilthex_arm", "solo8", "talos"])
def test_an_mjcf_written_from_a_robot_is_the_same_robot(tmp_path: Path, name: str) -> None:
    robot = known_robot(name)
    mjcf = build_mjcf(robot.model)
    mjcf.compile()
    copied = loaded(tmp_path, mjcf.spec.to_xml())
    assert copied.root == robot.root and copied.joint_names == robot.joint_names
    assert np.allclose(copied.armature, robot.armature, rtol=1e-5)
    for name in ("lowerPositionLimit", "upperPositionLimit"):
        assert np.allclose(getattr(copied.model, name)[7:], getattr(robot.model, name)[7:], atol=1e-5)
    q = robot.posture()
    M = mass_matrix(robot.model, q)
    assert np.abs(mass_matrix(copied.model, q) - M).max() < 1e-5 * np.abs(M).max()
    frame = robot.spec.contact.frame or robot.frame_names[-1]
    places = [frame_placement(each.model, q, each.frame_id(frame)) for each in (robot, copied)]
    assert places[0].isApprox(places[1], 1e-5)


def test_positions_are_those_of_qpos(tmp_path: Path) -> None:
    arm, home = loaded(tmp_path, ARM), own(ARM).key("home").qpos
    assert arm.default_posture == "home" and list(arm.postures) == ["home", "key1", "neutral"]
    assert np.allclose(arm.posture()[[0, 1]], home[:2])
    assert np.allclose(arm.posture()[2:4], [np.cos(home[2]), np.sin(home[2])])  # a hinge without a range
    assert np.allclose(arm.posture("neutral"), [0.4, 0, 1, 0, 0.02])
    dog = loaded(tmp_path, QUADRUPED)
    assert np.allclose(dog.posture()[:7], [0, 0, 0.4, 0, 0, 0, 1])
    half = np.radians(15)
    assert np.allclose(dog.posture("neutral")[:7], [0, 0, 0.45, 0, 0, np.sin(half), np.cos(half)])


def test_limits_efforts_and_armature(tmp_path: Path) -> None:
    arm = loaded(tmp_path, ARM)
    model = arm.model
    assert list(model.names[1:]) == ["shoulder", "elbow", "wrist", "reach"]
    assert np.allclose(arm.armature, [0.2 + 5**2 * 0.01, 0.1, 0, 0]) and arm.armature_source == "MJCF"
    # A motor has gear × control; actuatorfrcrange limits the sum; a servo without a force range has no limit.
    assert np.allclose(model.effortLimit[[0, 1, 3]], [50, 20, 24]) and np.isinf(model.effortLimit[2])
    assert np.isinf(arm.velocity_limits).all()
    assert np.allclose([model.lowerPositionLimit[0], model.upperPositionLimit[1]], [-2, 2.5])
    assert model.joints[3].shortname() == "JointModelRUBX"
    assert np.allclose(loaded(tmp_path, ARM, armature="none").armature, 0)
    assert any("damping (1), friction loss (1)" in line for line in arm.warnings)


def test_the_hash_of_the_data_contains_passive_forces(tmp_path: Path) -> None:
    arm, damped = loaded(tmp_path, ARM), loaded(tmp_path, ARM.replace('damping="1"', 'damping="2"'))
    assert arm.model_sha256 == damped.model_sha256 and arm.data_sha256 != damped.data_sha256


def test_root_option_adds_and_removes_the_free_joint(tmp_path: Path) -> None:
    dog, fixed = loaded(tmp_path, QUADRUPED), loaded(tmp_path, QUADRUPED, root="fixed")
    assert dog.root == "free-flyer" and dog.nv == 18
    assert fixed.root == "fixed" and fixed.nv == 12
    assert np.allclose(fixed.posture(), dog.posture()[7:])
    assert np.allclose(mass_matrix(fixed.model, fixed.posture()), mass_matrix(dog.model, dog.posture())[6:, 6:])
    flying = loaded(tmp_path, ARM, root="free-flyer")
    assert flying.nv == 6 + 4 and flying.mass == pytest.approx(6.9)
    with pytest.raises(MjcfError, match="one body on the world that does not move, not 2"):
        loaded(tmp_path, ODD, root="free-flyer")


def test_shapes_are_the_solid_geoms(tmp_path: Path) -> None:
    arm = loaded(tmp_path, ARM)
    solid, seen = read_shapes(arm).shapes, read_shapes(arm, "visual").shapes
    assert [(shape.link, shape.kind) for shape in solid] == [
        ("base", "cylinder"), ("upper", "capsule"), ("fore", "capsule"), ("hand", "ellipsoid"),
    ]  # fmt: skip
    assert [(shape.kind, shape.color) for shape in seen if shape.link == "upper"] == [("box", (1.0, 0.0, 0.0, 1.0))]
    assert any("a plane is not a shape of a link" in line for line in read_shapes(arm).warnings)
    model, data = own(ARM), mujoco.MjData(own(ARM))
    mujoco.mj_forward(model, data)
    placed = arm.model.createData()
    pin.forwardKinematics(arm.model, placed, arm.posture("neutral"))
    for shape in load_geometry(arm, solid).model.geometryObjects:
        at = placed.oMi[shape.parentJoint] * shape.placement
        body = model.body(shape.name)
        assert np.allclose(at.translation, data.geom_xpos[body.geomadr[0]], atol=1e-12)
    hand = load_geometry(arm, solid).model.geometryObjects[-1].geometry
    assert np.all(np.abs(shape_points(hand)).max(axis=0) >= [0.05, 0.04, 0.03])
    assert np.all(np.abs(shape_points(hand)).max(axis=0) < [0.052, 0.042, 0.032])


def test_meshes_are_hulls_in_contacts_and_surfaces_in_pictures(tmp_path: Path) -> None:
    robot = loaded(tmp_path, MESH)
    (wedge,) = read_shapes(robot).shapes
    points = shape_points(load_geometry(robot, [wedge]).model.geometryObjects[0].geometry)
    at = robot.model.frames[robot.frame_id("first")].placement * wedge.placement
    corners = points @ at.rotation.T + at.translation
    assert wedge.link == "first" and len(corners) == 6
    assert np.allclose(corners.min(axis=0), 0, atol=1e-7) and np.allclose(
        corners.max(axis=0), [0.2, 0.1, 0.1], atol=1e-7
    )
    seen = {shape.link: shape for shape in read_shapes(robot, "visual").shapes}
    assert seen["first"].kind == "sphere"
    assert len(shape_points(seen["second"].load(5.0).mesh)) == 7


def test_excluded_and_neighboring_bodies_may_touch(tmp_path: Path) -> None:
    pairs = disabled_links(loaded(tmp_path, ARM))
    assert {frozenset(("base", "fore")), frozenset(("upper", "fore"))} <= pairs
    assert frozenset(("base", "hand")) not in pairs and frozenset(("upper", "hand")) not in pairs
    # Two joints in one body connect the thigh with the trunk.
    assert frozenset(("trunk", "thigh_fl")) in disabled_links(loaded(tmp_path, QUADRUPED))


@pytest.mark.long(but=("lock0-tip", "lock3-wrist"))
@pytest.mark.parametrize(
    ("lock", "frame"), [((), "tip"), (("elbow",), "tip"), (("wrist", "shoulder"), "hand"), ((), "wrist")]
)
def test_verify_compares_with_the_file(tmp_path: Path, lock: tuple[str, ...], frame: str) -> None:
    robot = loaded(tmp_path, ARM, lock=lock)
    objective = WorstCaseObjective(robot, ImpactContact(frame, (0, 0, 1)))
    assert {row.verdict for row in verify(objective, samples=3).rows} == {"pass"}
    assert robot.mjcf is not None
    changed = copy.copy(robot.mjcf.model)
    changed.body_mass[-1] *= 1.001
    object.__setattr__(robot.mjcf, "model", changed)
    failed = {row.quantity for row in verify(objective, samples=3).rows if row.verdict == "fail"}
    # MuJoCo has no frames of joints, so the written model is compared for them.
    assert ("M" in failed) == (frame != "wrist")


def test_verify_counts_a_given_armature(tmp_path: Path) -> None:
    robot = loaded(tmp_path, QUADRUPED, armature={"knee_fl": 0.5})
    objective = WorstCaseObjective(robot, ImpactContact("trunk", (1, 0, 0)))
    assert {row.verdict for row in verify(objective, samples=2).rows} == {"pass"}


def test_draft_reads_feet_and_armature(tmp_path: Path) -> None:
    path = written(tmp_path, QUADRUPED)
    _, draft = write_draft(path, LoadOptions(), None)
    robot = load_robot(path)
    assert robot.spec.kind == "quadruped" and robot.spec.model.root == "free-flyer" and len(robot.spec.supports) == 4
    assert all(
        np.allclose(foot.offset, (0, 0, -0.225)) or foot.frame.startswith("foot") for foot in robot.spec.supports
    )
    assert "Armature: read from the MJCF, 0.01 to 0.01" in draft.text


def _with(text: str, **parts: str) -> str:
    return text.replace("</mujoco>", "".join(f"<{tag}>{part}</{tag}>" for tag, part in parts.items()) + "</mujoco>")


_TENDON = '<fixed name="cord"{}><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="1"/></fixed>'


_THREE = _TENDON.format("").replace("</fixed>", '<joint joint="wrist" coef="1"/></fixed>')
_OTHER = '<fixed name="other"><joint joint="elbow" coef="2"/><joint joint="wrist" coef="3"/></fixed>'


@pytest.mark.parametrize(
    ("equalities", "followers"),
    [
        ('<tendon tendon1="cord" polycoef=".2"/>', ["shoulder"]),
        ('<tendon tendon1="cord"/><tendon tendon1="other" polycoef=".1"/>', ["shoulder", "elbow"]),
        ('<joint joint1="shoulder" joint2="wrist"/><tendon tendon1="cord" polycoef=".1"/>', ["shoulder", "elbow"]),
        ('<tendon tendon1="single" tendon2="other" polycoef=".1 -.5"/>', ["elbow"]),
    ],
)
def test_equal_tendons_of_two_joints_are_couplings(tmp_path: Path, equalities: str, followers: list[str]) -> None:
    single = '<fixed name="single"><joint joint="elbow" coef="4"/></fixed>'
    text = _with(ARM, tendon=_TENDON.format("") + _OTHER + single, equality=equalities)
    robot, model = loaded(tmp_path, text), own(text)
    assert [coupling.follower for coupling in robot.couplings] == followers
    q, data = robot.coupled(np.array([0.7, -0.3, 0.2, 0.05])), mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    assert data.ne == len(followers) and np.abs(data.efc_pos[: data.ne]).max() < 1e-12
    data.qpos[:] += np.array([0.1, 0.2, 0.3, 0])
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.ne]).min() > 0.01


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (_with(ARM, equality='<connect name="rod" body1="hand" body2="base" anchor="0 0 0"/>'), "(connect) closes a"),
        (_with(ARM, equality='<weld body1="hand" body2="base"/>'), "'equality0' (weld) closes a kinematic loop"),
        (_with(ARM, tendon=_THREE, equality='<tendon tendon1="cord"/>'), "(tendon) couples more than two joints"),
        (_with(ARM, tendon=_TENDON.format(' armature="1"')), "the armature of tendon 'cord' couples joints"),
        (QUADRUPED.replace("</worldbody>", '<body name="ball"><freejoint/><geom size=".1"/></body></worldbody>')
         .replace("<key ", "<!--").replace('0 .5 .9 "/>', "-->"), "body 'ball' floats in addition to the robot"),
        ("<mujoco><worldbody/></mujoco>", "has no body"),
        ("<mujocoinclude><worldbody><body/></worldbody></mujocoinclude>", "name the file that includes"),
        ('<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>', "has no movable joint"),
        ("<mujoco><nothing/></mujoco>", "MuJoCo refuses it"),
        ('<mujoco><include file="robot.xml"/></mujoco>', "'robot.xml' already included"),
        (ARM.replace('mass=".4"', 'mass="1e308"').replace('size=".05 .04 .03"', 'size="1e9 1 1"'), "has an infinite"),
        (ARM.replace('contype="0"', 'contype="zero"'), "MuJoCo refuses it"),
        ("<mujoco><worldbody>", "MuJoCo refuses it"),
    ],
)  # fmt: skip
def test_refusals_name_the_fault_in_one_line(tmp_path: Path, text: str, line: str) -> None:
    with pytest.raises(MjcfError) as error:
        loaded(tmp_path, text)
    assert line in error.value.line and "\n" not in error.value.line and error.value.hint


def test_joints_beside_a_floating_robot_are_locked(tmp_path: Path) -> None:
    """Some vendors keep the joints of optional parts, with bodies that are attached to the world."""
    spare = '<body name="spare" pos="0 0 20"><joint name="gone"/><geom size=".1" mass=".001"/></body></worldbody>'
    robot, plain = loaded(tmp_path, QUADRUPED.replace("</worldbody>", spare)), loaded(tmp_path, QUADRUPED)
    assert "joints that are not attached to the floating base are locked: gone" in robot.warnings
    assert robot.joint_names == plain.joint_names and robot.locked == ("gone",)
    q = plain.posture()
    ours, reference = (pin.crba(each.model, each.model.createData(), q) for each in (robot, plain))
    np.testing.assert_allclose(ours, reference, rtol=1e-13)


def test_inactive_equality_is_no_loop(tmp_path: Path) -> None:
    equality = '<weld body1="hand" body2="base" active="false"/>'
    assert loaded(tmp_path, _with(ARM, equality=equality)).nv == 4


def test_missing_meshes(tmp_path: Path) -> None:
    text, tip = (
        ARM.replace("<worldbody>", '<asset><mesh name="m" file="m.stl"/></asset><worldbody>'),
        '<site name="tip"',
    )
    mesh, stated = f'<geom type="mesh" mesh="m"/>{tip}', '<inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>'
    drawn = text.replace(tip, stated + mesh)
    robot = loaded(tmp_path, drawn)
    assert robot.warnings[0] == "no mesh 'm.stl': their shapes are left out; the file states all inertias"
    assert "hand" in {shape.link for shape in read_shapes(robot).shapes}
    with pytest.raises(MjcfError, match=r"no mesh 'm\.stl', and body 'hand' takes its inertia from the mesh"):
        loaded(tmp_path, text.replace(tip, mesh))


def test_without_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(InputError, match=r"MuJoCo is not installed; pip install 'impact-posture\[sim\]'"):
        loaded(tmp_path, ARM)
