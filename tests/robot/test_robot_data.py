"""Data of the known robots: each ``robot.toml`` agrees with its model."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial import ConvexHull

from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.robot.urdf import robots_data
from tests.support.helpers import NAMES, robot

PROMISED = {
    "solo8", "solo12", "talos", "hextilt", "borinot", "panda", "ur5", "g1", "go2", "anymal_kinova", "tiago",
    "icub", "hyq", "tilthex_arm",
}  # fmt: skip
LEGGED = [
    "anymal_c", "anymal_kinova", "bolt", "g1", "go2", "hyq", "icub", "romeo", "solo12", "solo8", "talos",
]  # fmt: skip
TILTHEX_POSTURES = ["home", "tucked", "brace_down", "brace_forward", "brace_up"]


def kinematics(loaded: Robot, posture: str | None = None) -> pin.Data:
    """Return the data of Pinocchio with all frame placements at a named posture."""
    data = loaded.model.createData()
    pin.framesForwardKinematics(loaded.model, data, loaded.posture(posture))
    return data


def support_points(support: Support, loaded: Robot, data: pin.Data) -> np.ndarray:
    """Corners of the sole in the world (for a point foot, the same point four times)."""
    placement = data.oMf[loaded.frame_id(support.frame)]
    corners = [np.array([*support.size, 0.0]) * (x, y, 0) for x, y in product((-1, 1), repeat=2)]
    return np.array([placement.act(np.add(support.offset, corner)) for corner in corners])


def test_the_promised_robots_are_there() -> None:
    assert set(NAMES) >= PROMISED


@pytest.mark.parametrize("name", NAMES)
def test_named_joints_and_frames_exist(name: str) -> None:
    loaded = robot(name)
    spec = loaded.spec
    assert spec.name == name and spec.description
    assert spec.kind != "other" or name == "bolt"
    frames = {spec.contact.frame, *spec.contact.frames, *(s.frame for s in spec.supports)}
    if spec.propulsion is not None:
        frames.add(spec.propulsion.frame)
    links = {frame.name for frame in loaded.model.frames if frame.type == pin.FrameType.BODY}
    assert frames <= links, frames - links
    assert set(spec.constraints.hold) <= set(loaded.joint_names), "held joints are not locked"


@pytest.mark.parametrize("name", NAMES)
def test_a_stated_armature_names_its_source(name: str) -> None:
    loaded = robot(name)
    armature = loaded.spec.armature
    assert armature.source or (armature.default is None and not armature.joints)
    if armature.joints and armature.default is None and name != "icub":
        assert set(loaded.joint_names) <= set(armature.joints)


@pytest.mark.parametrize("name", LEGGED)
def test_feet_are_flat_on_one_plane_below_the_center_of_mass(name: str) -> None:
    loaded = robot(name)
    spec, data = loaded.spec, kinematics(loaded)
    points = np.vstack([support_points(s, loaded, data) for s in spec.supports])
    assert np.ptp(points[:, 2]) < 5e-3
    for support in spec.supports:
        if support.kind == "surface":
            assert data.oMf[loaded.frame_id(support.frame)].rotation[2, 2] > np.cos(np.radians(0.5))
            assert min(support.size) > 0
    if name != "bolt":  # The robot has two point feet.
        assert spec.constraints.com_over_feet
        com = pin.centerOfMass(loaded.model, data, loaded.posture())
        hull = ConvexHull(np.unique(points[:, :2].round(12), axis=0))
        depth = -np.max(hull.equations[:, :2] @ com[:2] + hull.equations[:, 2])
        assert depth > spec.constraints.com_margin


def test_tiago_keeps_torso_and_arm_only() -> None:
    assert robot("tiago").joint_names == ("torso_lift_joint", *(f"arm_{i}_joint" for i in range(1, 8)))


def test_tilthex_postures() -> None:
    loaded = robot("tilthex_arm")
    assert loaded.nv == 9
    assert loaded.joint_names == ("shoulder_roll", "shoulder_pitch", "elbow_pitch")
    assert set(loaded.postures) == {*TILTHEX_POSTURES, "neutral"}
    margin = loaded.spec.constraints.limit_margin
    for name in TILTHEX_POSTURES:
        joints = loaded.posture(name)[7:]
        assert (loaded.model.lowerPositionLimit[7:] + margin <= joints).all()
        assert (joints <= loaded.model.upperPositionLimit[7:] - margin).all()


def test_tilthex_inertias_are_possible() -> None:
    base, *links = list(robot("tilthex_arm").model.inertias)[1:]
    assert 2.3 <= base.mass <= 2.8
    np.testing.assert_allclose(np.diag(base.inertia), [0.0115, 0.0114, 0.0194])
    for inertia in (base, *links):
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert np.all(moments > 0)
        assert moments[0] + moments[1] >= moments[2] * (1 - 1e-9)
    for inertia in links:
        assert 0.1 <= inertia.mass <= 0.2


@pytest.mark.parametrize("posture", TILTHEX_POSTURES)
def test_tilthex_keeps_one_redundant_freedom(posture: str) -> None:
    loaded = robot("tilthex_arm")
    q, frame = loaded.posture(posture), loaded.frame_id("ee")
    data = loaded.model.createData()
    jacobian = pin.computeFrameJacobian(loaded.model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    tilt = np.eye(9)[3:5]
    values = np.linalg.svd(np.vstack([tilt, jacobian]), compute_uv=False)
    assert values.size == 8
    assert values[-1] > 0.5, "far from singular"


def test_tilthex_reaches_past_its_propellers() -> None:
    loaded = robot("tilthex_arm")
    forward, down, up = (
        kinematics(loaded, posture).oMf[loaded.frame_id("ee")].translation
        for posture in ("brace_forward", "brace_down", "brace_up")
    )
    assert loaded.spec.propulsion is not None
    radius = 0.15
    assert forward[0] > 0.54
    assert down[2] < -0.54
    assert up[2] > radius * np.sin(np.radians(30.0))
    # The arm passes between the disks of the two front rotors.
    for rotor in loaded.spec.propulsion.rotors:
        assert np.linalg.norm(rotor.position[:2]) == pytest.approx(0.39)
        assert abs(rotor.position[1]) > radius


def test_tilthex_has_a_license_and_no_meshes() -> None:
    folder: Path = robots_data() / "tilthex_arm"
    assert "Apache License" in (folder / "LICENSE").read_text(encoding="utf-8")
    assert "<mesh" not in (folder / "tilthex_arm.urdf").read_text(encoding="utf-8")
