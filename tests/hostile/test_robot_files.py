"""Damaged MJCFs and couplings, archives that grow, and files that are not regular give a short error."""

from __future__ import annotations

import json
import os
import time
import zipfile
from pathlib import Path

import pytest

from impact_posture.collision.mesh_file import UnusableShape, read_mesh
from impact_posture.collision.urdf_shapes import read_urdf_shapes
from impact_posture.robot.robot_loader import load_robot
from tests.hostile.arena import SMALL, strike

PUSH = ("--frame", "tip", "--normal", "1", "0", "0.2")
PATIENCE = 10  # s
GEOM = '<geom type="capsule" size=".03" fromto="0 0 0 0 0 .3"/>'
ARM = (
    '<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" range="-90 90"/>' + GEOM
    + '<body name="lower" pos="0 0 .3"><joint name="elbow" axis="0 1 0"/>' + GEOM
    + '<site name="tip" pos="0 0 .3"/></body></body></worldbody></mujoco>'
)  # fmt: skip
MIMIC = '<joint name="elbow" type="revolute"><mimic joint="shoulder" multiplier="1e200"/>'
MESH = '<asset><mesh name="m" file="pipe.stl"/></asset></mujoco>'
FLAT = '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1e38 0 0 0 1"/></asset><worldbody><geom type="mesh" mesh="m"/>'
FIELD = '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset></mujoco>'
FAULTS = {
    "name of the world": ("elbow", "universe", "two joints have the name 'universe'"),
    "name of a joint without a name": ('name="shoulder"', 'name="joint1"', "two joints"),
    "armature": ('name="elbow"', 'name="elbow" armature="nan"', "dof armature is not finite"),
    "endless armature": ('name="elbow"', 'name="elbow" armature="inf"', "dof armature is not finite"),
    "reference": ('name="elbow"', 'name="elbow" ref="inf"', "qpos0 is not finite"),
    "limit": ("-90 90", "-90 nan", "jnt range is not finite"),
    "damping": ('name="elbow"', 'name="elbow" damping="nan"', "dof damping is not finite"),
    "friction": ("<geom", '<geom friction="nan .1 .1"', "geom friction is not finite"),
    "bodies": ("</worldbody>", "<body/>" * 100_000 + "</worldbody>", "more than 5000 bodies"),
    "repetitions": ("<site", '<replicate count="1000000"><geom size=".1"/></replicate><site', "repetitions"),
    "mesh": ("</mujoco>", MESH, "'pipe.stl' is not a file"),
    "flat mesh": ("<worldbody>", FLAT, "MuJoCo refuses it"),
    "height field": ("</mujoco>", FIELD, "rows or columns"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_an_mjcf(name: str, arena: Path) -> None:
    old, new, words = FAULTS[name]
    os.mkfifo(arena / "pipe.stl")
    text = ARM.replace('name="elbow"', "", 1) if "joint1" in new else ARM
    (arena / "bad.xml").write_text(text.replace(old, new, 1))
    start = time.monotonic()
    outcome = strike(arena, "evaluate", "bad.xml", *PUSH)
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err[-500:]
    assert words in outcome.err and "bad.xml" in outcome.err
    assert time.monotonic() - start < PATIENCE


def test_an_mjcf_in_utf_16(arena: Path) -> None:
    (arena / "bad.xml").write_text(ARM, encoding="utf-16")
    outcome = strike(arena, "inspect", "bad.xml")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "bad.xml: is in UTF-16" in outcome.err
    (arena / "bad.xml").write_bytes(ARM.encode("utf-16-le"))
    outcome = strike(arena, "inspect", "bad.xml")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "bad.xml: is an MJCF that MuJoCo cannot read; save it as UTF-8" in outcome.err


def test_links_and_joints_of_gazebo_plugins_are_no_links_and_joints(arena: Path) -> None:
    """The plugins in published URDFs name links and joints by elements of these names."""
    plugin = "<gazebo><plugin><link>base</link><joint>elbow</joint><link name='other'><origin xyz='1e9 0 0'/></link>"
    (arena / "own.urdf").write_text(SMALL.replace("</robot>", f"{plugin}</plugin></gazebo></robot>"))
    (arena / "plain.urdf").write_text(SMALL)
    own, plain = (strike(arena, "evaluate", name, "--json", *PUSH) for name in ("own.urdf", "plain.urdf"))
    assert (own.code, own.complaints) == (0, []), own.err
    assert json.loads(own.out)["evaluation"] == json.loads(plain.out)["evaluation"]


@pytest.mark.parametrize("tag", ["disable_collisions", "rotor_params", "group_state"])
def test_an_srdf_with_nested_elements(tag: str, arena: Path) -> None:
    (arena / "deep.srdf").write_text(f"<robot>{f'<{tag}>' * 200_000}{f'</{tag}>' * 200_000}</robot>")
    outcome = strike(arena, "inspect", "small.urdf", "--srdf", "deep.srdf")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "deep.srdf: is not an SRDF" in outcome.err


@pytest.mark.parametrize("infinity", ["range", "forcerange"])
def test_ranges_may_be_infinite(infinity: str, arena: Path) -> None:
    motor = '</worldbody><actuator><motor joint="elbow" forcerange="-inf inf"/></actuator>'
    changes = {"range": ("-90 90", "-90 inf"), "forcerange": ("</worldbody>", motor)}
    (arena / "arm.xml").write_text(ARM.replace(*changes[infinity]))
    outcome = strike(arena, "inspect", "arm.xml")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('<joint name="elbow" type="revolute">', MIMIC, "infinite or huge"),
        ('"elbow"', '"universe"', "two joints have the name"),
        ("</robot>", "<!--" * 200_000, "is not XML"),
    ],
)
def test_faults_of_a_urdf(old: str, new: str, words: str, arena: Path) -> None:
    (arena / "bad.urdf").write_text(SMALL.replace(old, new))
    start = time.monotonic()
    outcome = strike(arena, "evaluate", "bad.urdf", *PUSH)
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err[-500:]
    assert words in outcome.err and "bad.urdf" in outcome.err
    assert time.monotonic() - start < PATIENCE


def test_entries_of_q_in_another_order(arena: Path) -> None:
    (arena / "p.json").write_text('{"q": [0.1, 0.2], "q_names": ["elbow (rad)", "shoulder (rad)"]}')
    outcome = strike(arena, "evaluate", "small.urdf", *PUSH, "--posture", "p.json")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "q_names that do not fit the robot" in outcome.err


def test_an_archive_that_grows(arena: Path) -> None:
    """The archive has 0.1 MB, and its content has 110 MB."""
    with zipfile.ZipFile(arena / "a.3mf", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("3D/3dmodel.model", b" " * 110_000_000)
    with pytest.raises(UnusableShape, match="3mf is larger than 100 MB"):
        read_mesh(arena / "a.3mf")


def test_a_mesh_that_ends_too_early(arena: Path) -> None:
    (arena / "a.glb").write_bytes(
        b"glTF\2\0\0\0" + b"\xff" * 8 + b"JSON" + b'{"scenes": [{"nodes": [0]}], "nodes": [{}]}'
    )
    mesh = '</inertial><collision><geometry><mesh filename="a.glb"/></geometry></collision>'
    (arena / "mesh.urdf").write_text(SMALL.replace("</inertial>", mesh, 1))
    (shape,) = read_urdf_shapes(load_robot(str(arena / "mesh.urdf"))).shapes
    start = time.monotonic()
    with pytest.raises(UnusableShape, match="cannot be read as a mesh"):
        shape.load(5.0)
    assert time.monotonic() - start < 1


@pytest.mark.parametrize("option", [("--armature", "shoulder=1"), ("--xacro-arg", "hand:=true")])
def test_two_values_of_one_name(option: tuple[str, str], arena: Path) -> None:
    outcome = strike(arena, "evaluate", "small.urdf", *PUSH, *option, option[0], option[1].replace("=", "=2"))
    assert (outcome.code, outcome.complaints) == (2, []), outcome.err
    assert "has two values" in outcome.err and option[0] in outcome.err
