"""Soles that are meshes: their draft, and feet without a size."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial import ConvexHull

from impact_posture.config.problem_settings import LoadOptions
from impact_posture.draft.draft import write_draft
from impact_posture.impact.supports import resolve_supports
from impact_posture.posture.analysis.posture_warnings import posture_warnings
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import RobotSpec, read_spec
from impact_posture.system.arrays import Array
from tests.support.biped import biped
from tests.support.settings import make_settings
from tests.support.urdfs import stl

# The box of a sole of 20 × 8 × 3 cm, whose lower face is 6 cm below the ankle.
SOLE = np.array(list(product((-0.08, 0.12), (-0.04, 0.04), (-0.06, -0.03))))
# This sole with an edge that is 2 mm higher.
UP = np.array([0.0, 0.0, 2e-3])
TREAD = np.array(list(product((-0.079, 0.119), (-0.0396, 0.0396), (-0.06, -0.03))))
MESH = '<collision><geometry><mesh filename="foot.stl"{}/></geometry></collision>'
BOX = '<collision><origin xyz="0.02 0 -0.045"/><geometry><box size="0.2 0.08 0.03"/></geometry></collision>'


def taper(points: Array) -> Array:
    """Return the sole with a toe of half the width."""
    narrow = np.where(points[:, 0] > 0, 0.5, 1.0)
    return points * np.stack([np.ones(len(points)), narrow, np.ones(len(points))], axis=1)


def ball() -> Array:
    random = np.random.default_rng(0).normal(size=(4000, 3))
    return np.array([0.02, 0.0, -0.03]) + 0.03 * random / np.linalg.norm(random, axis=1)[:, None]


def drafted(folder: Path, foot: str, mesh: Array = SOLE) -> RobotSpec:
    stl(folder / "foot.stl", mesh[ConvexHull(mesh).simplices])
    (folder / "biped.urdf").write_text(biped(foot))
    return read_spec(write_draft(str(folder / "biped.urdf"), LoadOptions(), None, force=True)[0])


@pytest.mark.parametrize(
    ("foot", "mesh"),
    [
        (BOX, SOLE),
        (MESH.format(""), SOLE),
        (MESH.format(' scale="0.001 0.001 0.001"'), 1000 * SOLE),
        (MESH.format("").replace("collision", "visual"), SOLE),
        (MESH.format(""), np.vstack([SOLE + UP, TREAD])),
    ],
    ids=["box", "mesh", "millimeters", "visual", "rounded"],
)
def test_a_mesh_gives_the_same_sole_as_a_box(tmp_path: Path, foot: str, mesh: Array) -> None:
    spec = drafted(tmp_path, foot, mesh)
    for side, support in zip(("left", "right"), spec.supports, strict=True):
        assert (support.frame, support.kind) == (f"{side}_foot", "surface")
        np.testing.assert_allclose(support.offset, [0.02, 0.0, -0.06], atol=2e-4)
        np.testing.assert_allclose(support.size, [0.1, 0.04], rtol=0.011)
    assert spec.constraints.com_over_feet


def test_the_rectangle_of_a_sole_lies_in_the_sole(tmp_path: Path) -> None:
    """With a toe of half the width, the largest rectangle has half the width of the sole and its full length."""
    left, right = drafted(tmp_path, MESH.format(""), taper(SOLE)).supports
    np.testing.assert_allclose(left.size, [0.1, 0.02], rtol=0.02)
    assert left.size == right.size


def test_sensors_below_a_sole_are_not_feet(tmp_path: Path) -> None:
    """On iCub, the tactile sensors of the skin are frames below the frame of the sole."""
    frames = "".join(
        f'<link name="{side}_{name}"/><joint name="to_{side}_{name}" type="fixed"><parent link="{side}_foot"/>'
        f'<child link="{side}_{name}"/><origin xyz="0 0 {z}"/></joint>'
        for side in ("left", "right")
        for name, z in (("sole", -0.05), ("sole_skin_0", -0.06))
    )
    (tmp_path / "biped.urdf").write_text(biped(BOX).replace("</robot>", f"{frames}</robot>"))
    spec = read_spec(write_draft(str(tmp_path / "biped.urdf"), LoadOptions(), None)[0])
    assert [support.frame for support in spec.supports] == ["left_sole", "right_sole"]
    assert {support.offset for support in spec.supports} == {(0.02, 0.0, -0.01)}


def test_feet_with_different_shapes_are_a_guess(tmp_path: Path) -> None:
    """Published robots may have collision shapes for one foot and only a visual mesh for the other."""
    stl(tmp_path / "foot.stl", (SOLE - 1.5 * UP)[ConvexHull(SOLE).simplices])
    left, _, right = biped(BOX).rpartition(BOX)
    for other, words in ((MESH.format(""), "differ by 3 mm in height, so compare their shapes"), (BOX, "")):
        (tmp_path / "biped.urdf").write_text(left + other + right)
        draft = write_draft(str(tmp_path / "biped.urdf"), LoadOptions(), None, force=True)[1]
        offsets = [line for line in draft.guesses if line.startswith("offset")]
        assert len(offsets) == (2 if words else 0) and all(words in line for line in offsets)


def test_a_round_mesh_is_a_point(tmp_path: Path) -> None:
    """Two feet on legs of six joints are surfaces; a ball gives them no size."""
    for support in drafted(tmp_path, MESH.format(""), ball()).supports:
        np.testing.assert_allclose(support.offset, [0.02, 0.0, -0.06], atol=2e-3)
        assert support.size == (0.0, 0.0)


def prepared(folder: Path, supports: str, foot: str = BOX, **settings: object) -> Prepared:
    (folder / "biped.urdf").write_text(biped(foot))
    text = '[model]\nroot = "free-flyer"\n[contact]\nframe = "hips"\npose = "free"\n'
    for side in ("left", "right"):
        text += f'[[supports]]\nframe = "{side}_foot"\nkind = "surface"\n{supports}\n'
    (folder / "robot.toml").write_text(text)
    values = {"robot": str(folder / "biped.urdf"), "normal": [-1.0, 0.0, 0.0], "holdable": True, **settings}
    return prepare(make_settings(values))


def test_a_surface_without_size_is_measured(tmp_path: Path) -> None:
    """Around the origin of the frame, the sole reaches only 8 cm backwards."""
    prepared(tmp_path, "")
    robot = load_robot(str(tmp_path / "biped.urdf"))
    assert {s.size for s in resolve_supports(robot, None)} == {(0.08, 0.04)}
    assert {s.size for s in resolve_supports(robot, ["left_foot:surface"])} == {(0.08, 0.04)}
    assert {s.size for s in resolve_supports(robot, ["left_foot:point"])} == {(0.0, 0.0)}
    stated = load_robot(str(tmp_path / "biped.urdf"), config=str(tmp_path / "robot.toml"))
    assert resolve_supports(stated, None)[0].offset == (0.0, 0.0, 0.0)


def test_the_upper_side_of_a_foot_is_not_a_sole(tmp_path: Path) -> None:
    turned = "".join(
        f'<link name="{side}_tip"/><joint name="to_{side}_tip" type="fixed"><parent link="{side}_foot"/>'
        f'<child link="{side}_tip"/><origin xyz="0.02 0 -0.06" rpy="{np.pi} 0 0"/></joint>'
        for side in ("left", "right")
    )
    (tmp_path / "biped.urdf").write_text(biped(BOX).replace("</robot>", f"{turned}</robot>"))
    robot = load_robot(str(tmp_path / "biped.urdf"), root="free-flyer")
    assert not any(s.has_sole for s in resolve_supports(robot, ["left_tip:surface", "right_tip:surface"]))


def test_a_surface_without_size_and_shape_bears_no_moment(tmp_path: Path) -> None:
    """Two feet that bear no moment cannot balance the robot, so a warning says where its center of mass is."""
    case = prepared(tmp_path, "", foot="", com=False)
    assert not any(s.has_sole for s in case.impact.supports)
    q = case.impact.q
    assert any("cannot balance the robot" in note for note in case.problem.notes)
    assert not any("center of mass" in line for line in posture_warnings(case, q, q, None))
    leaning, model = q.copy(), case.impact.robot.model
    for side in ("left", "right"):
        leaning[model.idx_qs[model.getJointId(f"to_{side}_thigh")]] = 0.6
    data = model.createData()
    pin.framesForwardKinematics(model, data, leaning)
    away = abs(pin.centerOfMass(model, data, leaning)[0] - data.oMf[model.getFrameId("left_foot")].translation[0])
    assert away > 0.15
    (line,) = (line for line in posture_warnings(case, q, leaning, None) if "center of mass" in line)
    assert f"{away:.2g} m outside the feet, so the robot falls: give the soles a size" in line
    sized = prepared(tmp_path, "size = [0.1, 0.04]", foot="", com=False)
    (line,) = (line for line in posture_warnings(sized, q, leaning, None) if "center of mass" in line)
    assert f"{away - 0.1 * np.cos(0.6):.2g} m outside the feet, so the robot falls: require `com_over_feet`" in line


def test_a_foot_in_the_ground_is_a_warning(tmp_path: Path) -> None:
    for supports, warned in (("", True), ("offset = [0.0, 0.0, -0.06]", False)):
        lines = [line for line in prepared(tmp_path, supports).impact.warnings if "in the ground" in line]
        assert len(lines) == 2 * warned
        assert not warned or "60 mm below the contact point of the foot left_foot" in lines[0]
        assert not warned or "[[supports]] offset = [0, 0, -0.06]" in lines[0]
