"""Guesses from the names and the geometry of a robot, and the drafted ``robot.toml``."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.collision.foot_shape import support
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.draft.draft import write_draft
from impact_posture.draft.toml_lines import Draft
from impact_posture.errors import InputError, OutputError, UrdfError
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.actuation import hover, torque_limits
from impact_posture.robot.guessed_parts import feet, tips
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import RobotSpec, read_spec
from impact_posture.robot.urdf import EXAMPLE_PREFIX, example_robot_data, robots_data
from tests.support.helpers import NAMES
from tests.support.settings import make_settings
from tests.support.urdfs import joint, link, load

B1_Z1 = "example-robot-data:b1_description/urdf/b1-z1.urdf"
FOUR = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")


def uri(folder: str) -> str:
    return EXAMPLE_PREFIX + folder


CATALOGUE: dict[str, RobotSpec] = {
    name: spec
    for name in NAMES
    if (spec := read_spec(robots_data() / name / "robot.toml")).model.urdf.startswith(EXAMPLE_PREFIX)  # type: ignore[union-attr]
}


@pytest.mark.parametrize(
    ("path", "expected", "tip"),
    [
        ("b1_description/urdf/b1-z1.urdf", FOUR, "gripperStator"),
        ("a1_description/urdf/a1.urdf", FOUR, "RR_foot"),
        ("solo_description/robots/solo12.urdf", ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), "HR_FOOT"),
        ("quadruped_description/urdf/quadruped.urdf", ("BL_contact", "BR_contact", "FL_contact", "FR_contact"),
         "FR_contact"),
        ("g1_description/urdf/g1_29dof_rev_1_0.urdf", ("left_ankle_roll_link", "right_ankle_roll_link"),
         "right_rubber_hand"),
        ("romeo_description/urdf/romeo.urdf", ("l_sole", "r_sole"), "r_gripper"),
        ("panda_description/urdf/panda.urdf", (), "panda_hand_tcp"),
        ("hextilt_description/urdf/hextilt_flying_arm_5.urdf", (), "flying_arm_5__gripper"),
        ("tiago_description/robots/tiago.urdf", (), "hand_tool_link"),
    ],
)  # fmt: skip
def test_feet_and_tips_by_names_and_geometry(path: str, expected: tuple[str, ...], tip: str) -> None:
    loaded = load_robot(uri(path), LoadOptions(root="free-flyer", lock_massless=True))
    assert feet(loaded) == expected
    ordered = tips(loaded, feet(loaded))
    assert ordered[0] == tip
    # The returned order includes every moving frame.
    assert set(ordered) == {str(f.name) for f in loaded.model.frames if f.parentJoint > 0} - {"root_joint"}


@pytest.mark.parametrize(
    ("path", "foot", "kind", "size"),
    [
        ("b1_description/urdf/b1-z1.urdf", "FL_foot", "point", (0, 0)),
        ("talos_data/robots/talos_reduced_box.urdf", "left_sole_link", "surface", (0.105, 0.065)),
        ("talos_data/robots/talos_reduced.urdf", "left_sole_link", "surface", (0.0852, 0.0318)),
        ("g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_ankle_roll_link", "surface", (0.085, 0.025)),
        ("go2_description/urdf/go2.urdf", "FL_foot", "point", (0, 0)),
    ],
)
def test_a_sole_is_read_from_balls_boxes_and_meshes(
    path: str, foot: str, kind: str, size: tuple[float, float]
) -> None:
    """The foot is a ball on b1, a box or a mesh on talos, four balls on g1, and a mesh of a ball on go2."""
    loaded = load_robot(uri(path), LoadOptions(root="free-flyer"))
    spec = support(loaded, foot, flat=False)
    assert spec.kind == kind
    assert spec.size == pytest.approx(size, abs=2e-4)
    assert any(spec.offset)
    if foot == "FL_foot":
        data = loaded.model.createData()
        pin.framesForwardKinematics(loaded.model, data, loaded.posture())
        down = data.oMf[loaded.frame_id(foot)].rotation @ np.array(spec.offset)
        # The lowest point of a ball is one radius below its center; the mesh of go2 is about 23 mm high.
        lowest, tolerance = ((0, 0, -0.04), 2e-4) if "b1" in path else ((0, 0, -0.023), 5e-3)
        np.testing.assert_allclose(down, lowest, atol=tolerance)


def commented(text: str) -> list[str]:
    """Return the lines with a key that have no comment in the same line or the line above."""
    lines = text.splitlines()
    keys = [k for k, line in enumerate(lines) if " = " in line and not line.startswith(("#", "schema"))]
    return [lines[k] for k in keys if "  # " not in lines[k] and not lines[k - 1].startswith("# ")]


@pytest.mark.parametrize("name", [*CATALOGUE, "b1-z1"])
def test_a_draft_loads_without_change(name: str, tmp_path: Path) -> None:
    """The draft, made from the URDF alone, has the root and feet of the known robot."""
    known = CATALOGUE.get(name)
    source = B1_Z1 if known is None else known.model.urdf
    assert source is not None
    out, draft = write_draft(source, LoadOptions(), tmp_path / "draft.toml")
    assert [p.name for p in tmp_path.iterdir()] == ["draft.toml"]
    assert tomllib.loads(draft.text) and out.read_text(encoding="utf-8") == draft.text
    loaded = load_robot(source, LoadOptions(config=str(out)))
    loaded.check_posture(loaded.posture())
    assert commented(draft.text) == []
    assert max(len(line) for line in draft.text.splitlines() if line.startswith("#")) <= 100
    assert loaded.spec.contact.frame in loaded.frame_names
    expected = FOUR if known is None else [s.frame for s in known.supports]
    assert sorted(s.frame for s in loaded.spec.supports) == sorted(expected)
    assert loaded.root == ("free-flyer" if known is None else known.model.root)
    if known is not None and known.kind != "other":
        assert loaded.spec.kind == known.kind
    assert not set(loaded.spec.constraints.hold) & set(loaded.locked)


def test_a_draft_beside_the_urdf_is_found_by_itself(tmp_path: Path) -> None:
    shutil.copy(example_robot_data() / B1_Z1.removeprefix(EXAMPLE_PREFIX), tmp_path)
    urdf = str(tmp_path / "b1-z1.urdf")
    (tmp_path / "srdf").mkdir()
    shutil.copy(example_robot_data() / "b1_description/srdf/b1-z1.srdf", tmp_path / "srdf" / "other.srdf")
    options = LoadOptions(srdf=str(tmp_path / "srdf" / "other.srdf"), armature={"joint1": 0.02}, lock=("jointGri*",))
    out, draft = write_draft(urdf, options, None)
    assert out == tmp_path / "robot.toml"
    loaded = load_robot(urdf)
    assert loaded.default_posture.startswith("standing") and loaded.locked == ("jointGripper",)
    assert loaded.armature[loaded.model.idx_vs[loaded.joint_id("joint1")]] == 0.02
    assert 'srdf = "srdf/other.srdf"  # as --srdf says' in draft.text
    with pytest.raises(OutputError, match="`force`"):
        write_draft(urdf, LoadOptions(), None)
    assert out.read_text() == draft.text
    write_draft(urdf, LoadOptions(root="fixed"), None, force=True)
    assert load_robot(urdf).root == "fixed"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b1-z1.urdf", "robot.toml", "srdf"]


def test_refused_drafts(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"panda: has its robot\.toml already"):
        write_draft("panda", LoadOptions(), tmp_path / "panda.toml")
    with pytest.raises(OutputError, match="cannot be written"):
        write_draft(B1_Z1, LoadOptions(), tmp_path / "nowhere" / "b1.toml")
    assert not list(tmp_path.iterdir())


def test_names_cannot_break_out_of_a_comment() -> None:
    draft = Draft()
    draft.key("name", 'a"\nb', 'a link named "x"\nroot = 1')
    assert tomllib.loads(draft.text) == {"name": 'a"\nb'}


def test_b1_z1_stays_upright_with_its_draft(tmp_path: Path) -> None:
    """Without a robot.toml, the optimal posture would be upside down."""
    out, _ = write_draft(B1_Z1, LoadOptions(), tmp_path / "b1-z1.toml")
    prepared = prepare(make_settings({"robot": B1_Z1, "config": str(out), "normal": (-1, 0, 0)}))
    solution = solve(prepared.problem, starts=2, jobs=1, compile="never")
    model, q = prepared.impact.robot.model, solution.q
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    assert pin.Quaternion(q[3:7]).toRotationMatrix()[2, 2] > 0.7
    tip = data.oMf[prepared.impact.robot.frame_id("gripperStator")].translation
    for foot in FOUR:
        at = data.oMf[prepared.impact.robot.frame_id(foot)].translation
        assert at[2] < q[2] - 0.2 and at[0] < tip[0], json.dumps({foot: list(at)})


QUAD_ARM = Path(__file__).parents[2] / "docs/examples/quad_arm"


def uncommented(text: str) -> str:
    """Return a draft with its commented table of propellers as a part of the file."""
    before, table = text.split("# [propulsion]\n")
    return before + "[propulsion]\n" + table.replace("\n# ", "\n").replace("\n#\n", "\n\n").removeprefix("# ")


@pytest.mark.parametrize("turning", [False, True])
def test_propellers_are_drafted_as_a_commented_table(turning: bool, tmp_path: Path) -> None:
    """From the frames, the draft gets the same positions, directions and spins as the handwritten robot.toml."""
    urdf = (QUAD_ARM / "quad_arm.urdf").read_text()
    if turning:
        urdf = re.sub(r'(name="rotor_\d_joint" type=)"fixed"', r'\1"continuous"', urdf)
    (tmp_path / "quad_arm.urdf").write_text(urdf)
    out, draft = write_draft(str(tmp_path / "quad_arm.urdf"), LoadOptions(), None)
    assert read_spec(out).propulsion is None and any("propellers rotor_0, rotor_1" in line for line in draft.guesses)
    out.write_text(uncommented(draft.text))
    loaded, by_hand = load_robot(str(tmp_path / "quad_arm.urdf")), read_spec(QUAD_ARM / "quad_arm.toml").propulsion
    assert loaded.root == "free-flyer" and loaded.joint_names == ("shoulder", "elbow")
    assert loaded.spec.contact.frame == "tool"
    propulsion = loaded.spec.propulsion
    assert propulsion is not None and by_hand is not None
    assert propulsion.rotors == by_hand.rotors and propulsion.frame == by_hand.frame
    held = hover(loaded.model, propulsion, loaded.posture())
    assert held.feasible and held.thrust_margin > 0.2


def test_a_multirotor_without_joints_is_drafted(tmp_path: Path) -> None:
    source = uri("iris_description/robots/iris_simple.urdf")
    spinning, _ = write_draft(uri("iris_description/robots/iris.urdf"), LoadOptions(), tmp_path / "spinning.toml")
    assert read_spec(spinning).contact.frame == "iris__base_link"
    out, draft = write_draft(source, LoadOptions(), tmp_path / "iris.toml")
    out.write_text(uncommented(draft.text))
    loaded = load_robot(source, LoadOptions(config=str(out)))
    assert (
        loaded.spec.propulsion is not None and hover(loaded.model, loaded.spec.propulsion, loaded.posture()).feasible
    )
    # PX4: front right and back left turn counterclockwise.
    assert [rotor.spin for rotor in loaded.spec.propulsion.rotors] == [1, 1, -1, -1]
    with pytest.raises(UrdfError, match="has no movable joint"):
        write_draft(source, LoadOptions(root="fixed"), tmp_path / "fixed.toml")


def test_axes_of_an_end_effector_are_no_tool(tmp_path: Path) -> None:
    """Some MJCFs mark the axes of the hand by sites ``ee_x``, ``ee_y`` and ``ee_z``."""
    mounts = [
        joint(f"{name}_mount", f"hand {name}", None, kind="fixed", more="") for name in ("ee_x", "ee_y", "grip")
    ]
    tree = [
        link("base", 1),
        link("hand", 1),
        joint("turn", "base hand"),
        *map(link, ("ee_x", "ee_y", "grip")),
        *mounts,
    ]
    assert tips(load(tmp_path, *tree))[0] == "hand"


def test_rotors_of_motors_are_no_propellers(tmp_path: Path) -> None:
    _, draft = write_draft(uri("b1_description/urdf/b1.urdf"), LoadOptions(), tmp_path / "b1.toml")
    assert "FL_hip_rotor" in (example_robot_data() / "b1_description/urdf/b1.urdf").read_text()
    assert "propulsion" not in draft.text


def test_the_example_is_the_same_arm_as_a_urdf_and_as_an_mjcf(tmp_path: Path) -> None:
    """The MJCF also contains the data that the robot.toml adds to the URDF, and does not weld the base."""
    pytest.importorskip("mujoco")
    xml, by_hand = (str(QUAD_ARM.parent / path) for path in ("rail_arm_mjcf/rail_arm.xml", "rail_arm/rail_arm.urdf"))
    out, draft = write_draft(xml, LoadOptions(), tmp_path / "rail_arm.toml")
    assert 'frame = "tool"' in draft.text and "[armature]" not in draft.text
    arms = [load_robot(xml, config=str(out)), load_robot(by_hand)]
    mjcf, urdf = (ImpactCase(arm, ImpactContact("tool", (-1.0, 0.0, 0.0))) for arm in arms)
    assert np.allclose(arms[0].posture(), arms[1].posture()) and arms[0].joint_names == arms[1].joint_names
    assert torque_limits(arms[0].model).tolist() == torque_limits(arms[1].model).tolist()
    values = [ImpactOracle(case).quantities(case.robot.posture()).H for case in (mjcf, urdf)]
    assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_the_contact_of_a_hand_without_an_arm_is_a_finger(tmp_path: Path) -> None:
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    parts, above = ['<link name="palm"/>'], "palm"
    for name in ("index_pip", "index_dip"):
        parts.append(
            f'<link name="{name}_link">{mass}</link><joint name="{name}" type="revolute"><axis xyz="0 1 0"/>'
        )
        parts.append(f'<origin xyz=".1 0 0"/><parent link="{above}"/><child link="{name}_link"/>')
        parts.append('<limit lower="0" upper="1" effort="1" velocity="1"/></joint>')
        above = f"{name}_link"
    (tmp_path / "hand.urdf").write_text(f'<robot name="hand">{"".join(parts)}</robot>')
    out, _ = write_draft(str(tmp_path / "hand.urdf"), LoadOptions(), tmp_path / "draft.toml")
    spec = read_spec(out)
    assert spec.contact.frame == above and not spec.constraints.hold
