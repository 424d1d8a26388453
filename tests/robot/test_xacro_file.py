"""xacro files: expanded with arguments, packages and relative meshes; faults in one line."""

from __future__ import annotations

import shutil
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from impact_posture.collision.coal_geometry import read_shapes
from impact_posture.config.problem_settings import LoadOptions, ProblemSettings
from impact_posture.config.text_parsers import parse_xacro_arguments
from impact_posture.draft.draft import write_draft
from impact_posture.errors import InputError, PackageNotFound, UrdfError
from impact_posture.posture.formulation.problem_file import dump_settings
from impact_posture.robot.robot_loader import load_robot
from tests.support.command import run

pytest.importorskip("xacro", reason="xacro is not installed (the extra 'robots')")

TETRAHEDRON = (
    "solid s\n"
    + "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {' '.join(p)}\n" for p in face) + "endloop\nendfacet\n"
        for face in (("000", "010", "100"), ("000", "100", "001"), ("000", "001", "010"), ("100", "010", "001"))
    )
    + "endsolid s\n"
)

ARM = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="mass" default="2"/>
  <xacro:arg name="hand" default="false"/>
  <xacro:include filename="$(find arm_description)/link.xacro"/>
  <link name="base"/>
  <xacro:link_of name="one" parent="base" mass="$(arg mass)" mesh="below/s.stl"/>
  <xacro:if value="$(arg hand)">
    <xacro:link_of name="hand" parent="one" mass="${0.5 * 2}" mesh="package://arm_description/meshes/s.stl"/>
  </xacro:if>
</robot>"""

LINK = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="link_of" params="name parent mass mesh">
    <link name="${name}">
      <inertial><mass value="${mass}"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><geometry><mesh filename="${mesh}"/></geometry></collision>
    </link>
    <joint name="${name}_joint" type="revolute"><parent link="${parent}"/><child link="${name}"/><axis xyz="0 0 1"/>
      <limit lower="-1" upper="1" effort="5" velocity="${pi}"/></joint>
  </xacro:macro>
</robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> str:
    files = {"urdf/arm.urdf.xacro": ARM, "link.xacro": LINK}
    files |= dict.fromkeys(("meshes/s.stl", "urdf/below/s.stl"), TETRAHEDRON)
    for name, text in files.items():
        path = tmp_path / "arm_description" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return str(tmp_path / "arm_description/urdf/arm.urdf.xacro")


def test_defaults_and_arguments(arm: str) -> None:
    plain, handed = load_robot(arm), load_robot(arm, xacro_arg={"hand": "true", "mass": "3"})
    assert (plain.name, plain.source, plain.joint_names) == ("arm", arm, ("one_joint",))
    assert plain.mass == pytest.approx(2) and handed.mass == pytest.approx(4)
    assert np.allclose(handed.velocity_limits, np.pi)
    shapes = read_shapes(handed)
    assert [shape.link for shape in shapes.shapes] == ["one", "hand"] and not shapes.warnings
    shutil.move(Path(arm).parent / "below", Path(arm).parents[1])
    assert not read_shapes(load_robot(arm)).warnings
    Path(arm).unlink()  # Shapes come from the expanded file.
    assert read_shapes(plain).described == ["one"]


def test_robot_toml_beside_the_xacro_file_is_read(arm: str) -> None:
    (Path(arm).parent / "robot.toml").write_text('schema = "impact-posture/robot/1"\nname = "mine"\n')
    assert load_robot(arm).name == "mine"


def test_draft_keeps_the_arguments(arm: str) -> None:
    path, draft = write_draft(arm, LoadOptions(xacro_arg={"hand": "true"}), None)
    assert path == Path(arm).parent / "robot.toml" and 'xacro_args = { "hand" = "true" }' in draft.text
    assert load_robot(arm).joint_names == ("one_joint", "hand_joint")
    assert load_robot(arm, xacro_arg={"hand": "false"}).joint_names == ("one_joint",)
    with pytest.raises(InputError, match="panda: is not a xacro file"):
        load_robot("panda", xacro_arg={"hand": "false"})


def test_command_line_and_problem_file(arm: str, tmp_path: Path) -> None:
    out = run("inspect", arm, "--xacro-arg", "hand:=true", "--json", cwd=tmp_path)
    assert '"hand_joint"' in out.stdout
    settings = ProblemSettings(robot=arm, xacro_arg={"hand": "true"})
    assert tomllib.loads(dump_settings(settings))["xacro_arg"] == {"hand": "true"}


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("${0.5 * 2}", "${0.5 * lost}", "name 'lost' is not defined"),
        ("</robot>", "", "cannot be expanded"),
        (ARM[ARM.index("  <link") :], "</robot>", "without links; name the file that uses its macros"),
        (
            "$(find arm_description)",
            "$(find arm_descriptoin)",
            "no path 'arm_descriptoin'; did you mean arm_description",
        ),
    ],
)
def test_faults(arm: str, old: str, new: str, line: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = Path(arm)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(UrdfError if "arm_desc" not in line else PackageNotFound) as error:
        load_robot(arm, xacro_arg={"hand": "true"})
    assert line in error.value.line and capfd.readouterr() == ("", "")


def test_missing_files(arm: str) -> None:
    with pytest.raises(UrdfError, match=r"gone\.xacro: no such file"):
        load_robot(str(Path(arm).parent / "gone.xacro"))
    Path(arm).write_text(Path(arm).read_text().replace("/link.xacro", "/gone.xacro"))
    with pytest.raises(UrdfError, match=r"gone\.xacro"):
        load_robot(arm)


def test_packages_of_ros(arm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def share(package: str) -> str:
        if package == "vendor_description":
            return str(Path(arm).parents[1])
        raise LookupError(package)

    index = ModuleType("ament_index_python.packages")
    index.get_package_share_directory = share  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ament_index_python", index)
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", index)
    Path(arm).write_text(ARM.replace("arm_description", "vendor_description"))
    assert load_robot(arm, xacro_arg={"hand": "true"}).nv == 2
    assert sys.modules["ament_index_python.packages"] is index
    Path(arm).write_text(ARM.replace("arm_description", "other_description"))
    with pytest.raises(PackageNotFound, match="no path 'other_description'"):
        load_robot(arm)


def test_unknown_arguments(arm: str) -> None:
    with pytest.raises(InputError, match=r"no argument 'hnad'; did you mean hand\?"):
        load_robot(arm, xacro_arg={"hnad": "true"})
    urdf = Path(arm).with_suffix("")
    urdf.write_text("<robot/>")
    with pytest.raises(InputError, match=r"is not a xacro file; leave `xacro_arg` out"):
        load_robot(str(urdf), xacro_arg={"hand": "true"})
    with pytest.raises(InputError, match="'hand=true' is not NAME:=VALUE"):
        parse_xacro_arguments(["hand=true"])


def test_without_xacro(arm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(InputError, match=r"xacro is not installed; pip install 'impact-posture\[robots\]'"):
        load_robot(arm)
