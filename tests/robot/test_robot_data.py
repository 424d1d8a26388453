"""The robots known by name: every robot.toml reads, and says only what the model bears out."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import impact_posture_robots
from impact_posture.robot.robot_spec import RobotSpec, Support, read_spec

ROBOTS = Path(impact_posture_robots.__path__[0])
NAMES = sorted(p.parent.name for p in ROBOTS.glob("*/robot.toml"))
PROMISED = {
    "solo8", "solo12", "talos", "hextilt", "borinot", "panda", "ur5", "g1", "go2", "anymal_kinova", "tiago",
    "icub", "hyq", "tilthex_arm",
}  # fmt: skip
SCHEME = "example-robot-data:"
LEGGED = [
    "anymal_c", "anymal_kinova", "bolt", "g1", "go2", "hyq", "icub", "romeo", "solo12", "solo8", "talos",
]  # fmt: skip
TILTHEX_POSTURES = ["home", "tucked", "brace_down", "brace_forward", "brace_up"]


def _data_root() -> Path:
    # The package has data only; cmeel installs it beside pinocchio.
    for base in Path(pin.__file__).resolve().parents:
        found = base / "cmeel.prefix" / "share" / "example-robot-data" / "robots"
        if found.is_dir():
            return found
        found = base / "share" / "example-robot-data" / "robots"
        if found.is_dir():
            return found
    pytest.fail("example-robot-data is not installed")


def _path(name: str, text: str) -> Path:
    if text.startswith(SCHEME):
        return _data_root() / text.removeprefix(SCHEME)
    return ROBOTS / name / text


@functools.cache
def spec_of(name: str) -> RobotSpec:
    return read_spec(ROBOTS / name / "robot.toml")


@functools.cache
def full_model(name: str) -> pin.Model:
    """The model with its SRDF postures, before any joint is locked."""
    spec = spec_of(name)
    assert spec.model.urdf is not None
    urdf = str(_path(name, spec.model.urdf))
    floating = spec.model.root == "free-flyer"
    model = pin.buildModelFromUrdf(urdf, pin.JointModelFreeFlyer()) if floating else pin.buildModelFromUrdf(urdf)
    if spec.model.srdf is not None:
        pin.loadReferenceConfigurations(model, str(_path(name, spec.model.srdf)), False)
    return model


def postures(name: str) -> dict[str, np.ndarray]:
    """All named postures of a robot, SRDF's and ours."""
    model, spec = full_model(name), spec_of(name)
    result = {entry.key(): np.array(entry.data()) for entry in model.referenceConfigurations}
    for key, posture in spec.postures.items():
        q = pin.neutral(model)
        if posture.base is not None:
            q[:7] = posture.base
        for joint_name, value in posture.joints.items():
            joint = model.joints[model.getJointId(joint_name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        result[key] = q
    return result


def default_posture(name: str) -> np.ndarray:
    key = spec_of(name).default_posture
    assert key is not None
    return postures(name)[key]


def body_frame(model: pin.Model, name: str) -> int:
    assert model.existFrame(name, pin.FrameType.BODY), name
    return int(model.getFrameId(name, pin.FrameType.BODY))


def limits(name: str) -> dict[str, tuple[float, float]]:
    """Position limits by joint with one coordinate, ours over the URDF's."""
    model, spec = full_model(name), spec_of(name)
    result = {}
    for i in range(1, model.njoints):
        joint = model.joints[i]
        if joint.nq == 1:
            result[model.names[i]] = (
                float(model.lowerPositionLimit[joint.idx_q]),
                float(model.upperPositionLimit[joint.idx_q]),
            )
    return result | dict(spec.limits.position)


def support_points(support: Support, data: pin.Data, model: pin.Model) -> np.ndarray:
    """Corners of the sole (one point for a point foot), in the world."""
    placement = data.oMf[body_frame(model, support.frame)]
    x, y = support.size
    corners = [(x, y), (x, -y), (-x, y), (-x, -y)] if x or y else [(0.0, 0.0)]
    return np.array([placement.act(np.add(support.offset, [a, b, 0.0])) for a, b in corners])


def test_every_robot_of_the_issue_is_there() -> None:
    assert set(NAMES) >= PROMISED


@pytest.mark.parametrize("name", NAMES)
def test_spec_reads_and_its_files_exist(name: str) -> None:
    spec = spec_of(name)
    assert spec.name == name
    assert spec.description
    assert spec.kind != "other" or name == "bolt"
    assert spec.model.urdf is not None
    assert _path(name, spec.model.urdf).is_file()
    if spec.model.srdf is not None:
        assert _path(name, spec.model.srdf).is_file()


@pytest.mark.parametrize("name", NAMES)
def test_named_joints_and_frames_exist(name: str) -> None:
    spec, model = spec_of(name), full_model(name)
    assert spec.contact.frame is not None
    frames = {spec.contact.frame, *spec.contact.frames, *(s.frame for s in spec.supports)}
    if spec.propulsion is not None:
        frames.add(spec.propulsion.frame)
    for frame in frames:
        body_frame(model, frame)
    joints = {*spec.model.lock, *spec.constraints.hold, *spec.armature.joints}
    joints |= {*spec.limits.position, *spec.limits.velocity, *spec.limits.effort}
    joints |= {joint for posture in spec.postures.values() for joint in posture.joints}
    assert joints <= set(model.names), joints - set(model.names)
    assert not set(spec.model.lock) & set(spec.constraints.hold)


@pytest.mark.parametrize("name", NAMES)
def test_default_posture_is_within_limits(name: str) -> None:
    model, q = full_model(name), default_posture(name)
    assert np.all(np.isfinite(q))
    assert np.linalg.norm(pin.normalize(model, q) - q) < 1e-3
    outside = {}
    for joint_name, (lower, upper) in limits(name).items():
        assert lower < upper
        value = float(q[model.joints[model.getJointId(joint_name)].idx_q])
        if not lower - 1e-9 <= value <= upper + 1e-9:
            outside[joint_name] = (lower, value, upper)
    assert not outside


@pytest.mark.parametrize("name", NAMES)
def test_a_stated_armature_names_its_source(name: str) -> None:
    armature = spec_of(name).armature
    if armature.default is not None or armature.joints:
        assert armature.source
    if armature.joints:
        model = full_model(name)
        missing = [model.names[i] for i in range(2, model.njoints) if model.names[i] not in armature.joints]
        assert not missing or armature.default is not None or name == "icub", missing


@pytest.mark.parametrize("name", LEGGED)
def test_feet_are_flat_on_one_plane(name: str) -> None:
    spec, model, q = spec_of(name), full_model(name), default_posture(name)
    assert spec.supports
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    points = np.vstack([support_points(s, data, model) for s in spec.supports])
    assert np.ptp(points[:, 2]) < 5e-3
    for support in spec.supports:
        if support.kind == "surface":
            assert data.oMf[body_frame(model, support.frame)].rotation[2, 2] > np.cos(np.radians(0.5))
            assert min(support.size) > 0


@pytest.mark.parametrize("name", [n for n in LEGGED if n != "bolt"])
def test_centre_of_mass_is_over_the_feet(name: str) -> None:
    spatial = pytest.importorskip("scipy.spatial")
    spec, model, q = spec_of(name), full_model(name), default_posture(name)
    assert spec.constraints.com_over_feet
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    com = pin.centerOfMass(model, data, q)
    points = np.vstack([support_points(s, data, model) for s in spec.supports])[:, :2]
    hull = spatial.ConvexHull(points)
    depth = -np.max(hull.equations[:, :2] @ com[:2] + hull.equations[:, 2])
    assert depth > spec.constraints.com_margin


def test_tiago_keeps_torso_and_arm_only() -> None:
    spec, model = spec_of("tiago"), full_model("tiago")
    left = [n for n in list(model.names)[1:] if n not in spec.model.lock]
    assert left == ["torso_lift_joint", *(f"arm_{i}_joint" for i in range(1, 8))]


def test_tilthex_postures() -> None:
    model = full_model("tilthex_arm")
    assert model.nv == 9
    assert [model.names[i] for i in range(2, 5)] == ["shoulder_roll", "shoulder_pitch", "elbow_pitch"]
    assert set(postures("tilthex_arm")) == set(TILTHEX_POSTURES)
    margin = spec_of("tilthex_arm").constraints.limit_margin
    for q in postures("tilthex_arm").values():
        for joint_name, (lower, upper) in limits("tilthex_arm").items():
            value = q[model.joints[model.getJointId(joint_name)].idx_q]
            assert lower + margin <= value <= upper - margin


def test_tilthex_inertias_are_possible() -> None:
    model = full_model("tilthex_arm")
    assert 2.3 <= model.inertias[1].mass <= 2.8
    np.testing.assert_allclose(np.diag(model.inertias[1].inertia), [0.0115, 0.0114, 0.0194])
    for inertia in list(model.inertias)[1:]:
        assert inertia.mass > 0
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert np.all(moments > 0)
        assert moments[0] + moments[1] >= moments[2] * (1 - 1e-9)
    for inertia in list(model.inertias)[2:]:
        assert 0.1 <= inertia.mass <= 0.2


@pytest.mark.parametrize("posture", TILTHEX_POSTURES)
def test_tilthex_keeps_one_redundant_freedom(posture: str) -> None:
    model, q = full_model("tilthex_arm"), postures("tilthex_arm")[posture]
    data = model.createData()
    frame = body_frame(model, "ee")
    jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    tilt = np.eye(9)[3:5]
    values = np.linalg.svd(np.vstack([tilt, jacobian]), compute_uv=False)
    assert values.size == 8
    assert values[-1] > 0.5, "far from singular"


def test_tilthex_reaches_past_its_propellers() -> None:
    model = full_model("tilthex_arm")
    data = model.createData()
    frame = body_frame(model, "ee")

    def ee(name: str) -> np.ndarray:
        pin.framesForwardKinematics(model, data, postures("tilthex_arm")[name])
        return np.array(data.oMf[frame].translation)

    propulsion = spec_of("tilthex_arm").propulsion
    assert propulsion is not None
    radius = 0.15
    assert ee("brace_forward")[0] > 0.54
    assert ee("brace_down")[2] < -0.54
    assert ee("brace_up")[2] > radius * np.sin(np.radians(30.0))
    # The arm leaves the disc plane between the two front rotors.
    for rotor in propulsion.rotors:
        assert np.linalg.norm(rotor.position[:2]) == pytest.approx(0.39)
        assert abs(rotor.position[1]) > radius


def test_tilthex_has_a_licence_and_no_meshes() -> None:
    folder = ROBOTS / "tilthex_arm"
    assert "Apache License" in (folder / "LICENSE").read_text(encoding="utf-8")
    assert "<mesh" not in (folder / "tilthex_arm.urdf").read_text(encoding="utf-8")
