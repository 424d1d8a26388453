"""Unusable collision shapes, damaged caches, and impossible obstacles."""

from __future__ import annotations

import json
import os
import stat
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.collision import robot_shapes as collision_shapes
from impact_posture.collision.mesh_check import MeshCheck
from impact_posture.collision.robot_shapes import NO_SHAPES, RobotShapes, load_shapes
from impact_posture.collision.swept_hull import distance_from_hull, obstacle_hull
from impact_posture.config.obstacle import Obstacle
from impact_posture.config.table_validation import validate
from impact_posture.errors import InputError, SpecError, UrdfError
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.sealed_files import sealed_text
from tests.support.urdfs import joint, link, stl

TETRAHEDRON = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
BOX = '<box size="0.1 0.1 0.2"/>'
SHOULDER = joint("shoulder", "base middle", at="0 0 0.3")


def shaped(name: str, *geometries: str, tag: str = "collision") -> str:
    return link(name, 1, more="".join(f"<{tag}><geometry>{geometry}</geometry></{tag}>" for geometry in geometries))


def arm(folder: Path, *shapes: str, tag: str = "collision") -> RobotShapes:
    """Return the shapes of an arm with three links: a box, the given shapes, and a box."""
    text = f'<robot name="arm">{shaped("base", BOX)}{shaped("middle", *shapes, tag=tag)}{shaped("tip", BOX)}'
    (folder / "arm.urdf").write_text(f"{text}{SHOULDER}{joint('elbow', 'middle tip', at='0 0 0.3')}</robot>")
    return load_shapes(load_robot(str(folder / "arm.urdf"), armature="none"))


def fresh() -> None:
    """Clear the memory cache of shapes, as in a new process."""
    collision_shapes._shapes.cache_clear()


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    fresh()
    return tmp_path / "cache" / "shapes"


def mesh(name: str, scale: str = "") -> str:
    return f'<mesh filename="{name}"{scale}/>'


@pytest.mark.parametrize("content, fault", [
    ("nan", "not finite"),
    ("infinite", "not finite"),
    ("all nan", "not finite"),
    ("no triangles", "cannot be read as a mesh, or is empty"),
    ("empty file", "cannot be read as a mesh, or is empty"),
    ("text", "cannot be read as a mesh, or is empty"),
    ("one point", "cannot be read as a mesh, or is empty"),
    ("millimeters", "so it is not in meters; give its <mesh> a scale"),
    ("missing", "no mesh 'bad.stl'; correct the path"),
    ("folder", "no mesh 'bad.stl'; correct the path"),
])  # fmt: skip
def test_a_bad_mesh_is_left_out_by_name(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], content: str, fault: str
) -> None:
    path, good = tmp_path / "bad.stl", TETRAHEDRON[FACES]
    if content in ("nan", "infinite", "all nan"):
        bad = np.array(good)
        bad[(slice(None),) if content == "all nan" else (1, 2, 0)] = np.inf if content == "infinite" else np.nan
        stl(path, bad)
    elif content == "folder":
        path.mkdir()
    elif content == "text":
        path.write_text("no mesh\n")
    elif content == "empty file":
        path.touch()
    elif content != "missing":
        stl(path, {"no triangles": good[:0], "one point": good * 0, "millimeters": good * 1000}[content])
    shapes = arm(tmp_path, mesh("bad.stl"), BOX)
    (line,) = shapes.warnings
    assert line.startswith("shape middle[0] is left out: ") and fault in line and "\n" not in line
    # The valid shapes are used, and nothing is printed.
    assert {body.name for body in shapes.bodies} == {"base", "middle[1]", "tip"}
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("geometry, fault", [
    ('<box size="0.1 nan 0.1"/>', "<box size> is '0.1 nan 0.1'; give 3 finite numbers"),
    ('<box size="0.1 0.1"/>', "give 3 finite numbers"),
    ('<box/>', "<box size> is ''"),
    ('<sphere radius="0"/>', "size of 0; give sizes above zero"),
    ('<sphere radius="-0.1"/>', "size of -0.1"),
    ('<cylinder radius="0.1" length="big"/>', "<cylinder length> is 'big'; give 1 finite number"),
    ('<pyramid size="1"/>', "its <geometry> is <pyramid>; give box"),
    ("", "its <geometry> is empty"),
    ('<mesh filename="package://nowhere/bad.stl"/>', "name the folder above the package with `package_dir`"),
    ('<mesh filename=""/>', "no mesh ''"),
    ('<mesh filename="good.stl" scale="0 1 1"/>', "size of 0"),
])  # fmt: skip
def test_a_bad_description_is_left_out_by_name(tmp_path: Path, geometry: str, fault: str) -> None:
    from impact_posture.collision.urdf_shapes import read_urdf_shapes

    stl(tmp_path / "good.stl", TETRAHEDRON[FACES])
    text = f'<robot name="arm">{shaped("base", BOX)}{shaped("middle", BOX)}{SHOULDER}</robot>'
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(text)
    robot = load_robot(str(urdf), armature="none")
    # Add the invalid shape after the robot is loaded, because some Pinocchio versions cannot read such shapes.
    urdf.write_text(text.replace(shaped("middle", BOX), shaped("middle", geometry)))
    shapes, (line,), links = read_urdf_shapes(robot)
    assert [shape.name for shape in shapes] == ["base"] and links == ["base", "middle"]
    assert line.startswith("shape middle is left out: ") and fault in line


def test_a_ball_of_millimeters_is_left_out(tmp_path: Path) -> None:
    shapes = arm(tmp_path, '<sphere radius="50"/>')
    size, bare = shapes.warnings
    assert size == "shape middle is left out: its <sphere> has a size of 50 m; give sizes in meters"
    assert bare.startswith("links without shapes: middle; ") and shapes.without_shapes == ("middle",)


def test_files_that_change_after_loading_are_one_line(tmp_path: Path) -> None:
    text = f'<robot name="arm">{shaped("base", BOX)}{shaped("middle", BOX)}{SHOULDER}</robot>'
    urdf, srdf = tmp_path / "arm.urdf", tmp_path / "arm.srdf"
    urdf.write_text(text)
    srdf.write_text('<robot name="arm"/>')

    def load() -> Robot:
        return load_robot(str(urdf), armature="none", srdf=str(srdf))

    robot = load()
    urdf.write_text(text.replace("</robot>", f"{shaped('new')}</robot>"))
    with pytest.raises(UrdfError, match="has changed since the robot was loaded"):
        load_shapes(robot)
    urdf.unlink()
    with pytest.raises(UrdfError, match="no such file"):
        load_shapes(robot)
    urdf.write_text(text)
    robot = load()
    srdf.write_text("<robot")
    with pytest.raises(UrdfError, match="is not an SRDF"):
        load_shapes(robot)


def test_an_open_mesh_is_closed_by_its_hull(tmp_path: Path) -> None:
    stl(tmp_path / "open.stl", TETRAHEDRON[FACES][:2])
    shapes = arm(tmp_path, mesh("open.stl"))
    body = next(body for body in shapes.bodies if body.link == "middle")
    assert not shapes.warnings
    assert {tuple(np.round(v, 6).tolist()) for v in body.vertices} == {tuple(v) for v in TETRAHEDRON.tolist()}


def test_a_corner_with_hundreds_of_edges(tmp_path: Path) -> None:
    """Check a fine cone: coal supports 255 edges per corner, but the tip of the cone has 400 edges."""
    angles = np.linspace(0, 2 * np.pi, 401)
    rim = 0.08 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    tip = np.broadcast_to([0.0, 0.0, 0.2], (400, 3))
    stl(tmp_path / "cone.stl", np.stack([rim[:-1], rim[1:], tip], axis=1))
    shapes = arm(tmp_path, mesh("cone.stl"), BOX)
    assert not shapes.warnings
    cone = [body for body in shapes.bodies if body.link == "middle" and body.vertices[:, 2].max() > 0.15]
    assert len(cone) == 1 and len(cone[0].vertices) <= 40
    assert all(distance_from_hull(point, cone[0]) < 1e-9 for point in (*rim, tip[0]))


def test_millimeters_with_a_scale_and_mirrored_meshes_are_fine(tmp_path: Path) -> None:
    stl(tmp_path / "large.stl", TETRAHEDRON[FACES] * 1000)
    shapes = arm(tmp_path, mesh("large.stl", ' scale="0.001 0.001 -0.001"'))
    body = next(body for body in shapes.bodies if body.link == "middle")
    np.testing.assert_allclose(body.vertices.min(axis=0), [0, 0, -0.1], atol=1e-7)
    assert not shapes.warnings


def test_meshes_of_packages_and_visual_shapes(tmp_path: Path) -> None:
    (tmp_path / "elsewhere" / "parts").mkdir(parents=True)
    stl(tmp_path / "elsewhere" / "parts" / "a b.stl", TETRAHEDRON[FACES])
    middle = shaped("middle", mesh("package://parts/a b.stl"), tag="visual")
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{shaped("base", BOX)}{middle}{SHOULDER}</robot>')
    folder = str(tmp_path / "elsewhere")
    shapes = load_shapes(load_robot(str(tmp_path / "arm.urdf"), armature="none", package_dir=(folder,)))
    assert [body.link for body in shapes.bodies] == ["base", "middle"] and not shapes.warnings


def test_a_robot_without_shapes_says_so(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{shaped("base")}{shaped("middle")}{SHOULDER}</robot>')
    robot = load_robot(str(tmp_path / "arm.urdf"), armature="none")
    shapes = load_shapes(robot)
    assert shapes.warnings == (NO_SHAPES,)
    assert shapes.bodies == () and shapes.pairs.shape == (0, 2)
    assert MeshCheck(robot, shapes).collisions(robot.posture()) == []


def test_a_hundred_thousand_faces_take_less_than_five_seconds(tmp_path: Path) -> None:
    """The mesh is a ball with a wavy surface."""
    count = 224
    polar, around = np.meshgrid(np.linspace(0, np.pi, count), np.linspace(0, 2 * np.pi, count), indexing="ij")
    radius = 0.1 * (1 + 0.1 * np.sin(5 * polar) * np.cos(4 * around))
    ball = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    ball *= radius[..., None]
    a, b, c, d = ball[:-1, :-1], ball[1:, :-1], ball[1:, 1:], ball[:-1, 1:]
    halves = [np.stack(half, axis=-2).reshape(-1, 3, 3) for half in ((a, b, c), (a, c, d))]
    stl(tmp_path / "fine.stl", np.concatenate(halves))
    start = time.process_time()
    shapes = arm(tmp_path, mesh("fine.stl"))
    assert time.process_time() - start < 5
    body = next(body for body in shapes.bodies if body.link == "middle")
    assert len(body.vertices) <= 40 and body.radius < 0.02
    # If a second robot has the same files, the cached shapes are reused.
    assert arm(tmp_path, mesh("fine.stl")) is shapes


# ---- the cache ----------------------------------------------------------------------------------------------------


def stored(cache: Path) -> Path:
    (path,) = cache.glob("*.json")
    return path


def test_the_cache_is_used_and_depends_on_content(tmp_path: Path, own_cache: Path) -> None:
    stl(tmp_path / "part.stl", TETRAHEDRON[FACES])
    first = arm(tmp_path, mesh("part.stl"))
    path = stored(own_cache)
    written = path.stat().st_mtime_ns
    fresh()
    again = arm(tmp_path, mesh("part.stl"))
    assert path.stat().st_mtime_ns == written
    for a, b in zip(first.bodies, again.bodies, strict=True):
        assert (a.name, a.link, a.joint, a.radius) == (b.name, b.link, b.joint, b.radius)
        np.testing.assert_array_equal(a.vertices, b.vertices)
    np.testing.assert_array_equal(first.pairs, again.pairs)
    stl(tmp_path / "part.stl", TETRAHEDRON[FACES] * 0.9)
    assert arm(tmp_path, mesh("part.stl")).bodies[1].reach < first.bodies[1].reach
    assert len(list(own_cache.glob("*.json"))) == 2


@pytest.mark.parametrize("damage", ["cut", "binary", "number", "fields"])
def test_a_damaged_cache_is_fitted_again(tmp_path: Path, own_cache: Path, damage: str) -> None:
    first = arm(tmp_path, BOX)
    path = stored(own_cache)
    raw = path.read_bytes()
    if damage == "fields":
        # The checksum is correct, but a field is missing.
        content = json.loads(raw.split(b"\n", 1)[1])
        del content["pairs"]
        path.write_text(sealed_text(json.dumps(content)))
    else:
        other = raw.replace(b'"radius":', b'"radius":1')
        assert other != raw
        path.write_bytes({"cut": raw[:-9], "binary": os.urandom(999), "number": other}[damage])
    fresh()
    again = arm(tmp_path, BOX)
    np.testing.assert_array_equal(first.bodies[0].vertices, again.bodies[0].vertices)
    np.testing.assert_array_equal(first.pairs, again.pairs)


def test_a_cache_that_others_may_write_is_not_read(tmp_path: Path, own_cache: Path) -> None:
    arm(tmp_path, BOX)
    path = stored(own_cache)
    content = json.loads(path.read_text().split("\n", 1)[1])
    content["bodies"][0]["radius"] = 0.5
    text = json.dumps(content)
    path.write_text(sealed_text(text))
    fresh()
    assert arm(tmp_path, BOX).bodies[0].radius == 0.5
    for place in (path, own_cache):
        mode = place.stat().st_mode
        place.chmod(mode | stat.S_IWOTH)
        fresh()
        assert arm(tmp_path, BOX).bodies[0].radius < 0.5
        place.chmod(mode)
        path.write_text(sealed_text(text))


# ---- obstacles ----------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
def test_a_box_has_its_pose(seed: int) -> None:
    random = np.random.default_rng(seed)
    edges, position, quaternion = random.uniform(0.1, 2, 3), random.normal(size=3), random.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    numbers = {"box": edges, "position": position, "quaternion": quaternion}
    box = obstacle_hull(Obstacle(name="box", **{key: tuple(array.tolist()) for key, array in numbers.items()}))
    local = (box.vertices - position) @ pin.XYZQUATToSE3(np.r_[position, quaternion]).rotation
    np.testing.assert_allclose(np.abs(local), np.tile(edges / 2, (8, 1)), atol=1e-12)
    assert box.joint == 0 and box.name == "box"


@pytest.mark.parametrize("values, words", [
    ({}, "neither edge lengths nor a radius"),
    ({"box": (1.0, 1.0, 1.0), "sphere": 1.0}, "edge lengths and a radius"),
    ({"sphere": 0.0}, "above zero"),
    ({"sphere": float("nan")}, "above zero"),
    ({"box": (1.0, -1.0, 1.0)}, "above zero"),
    ({"sphere": 1.0, "position": (0.0, 0.0, float("inf"))}, "finite"),
    ({"sphere": 1.0, "quaternion": (0.0, 0.0, 0.0, 2.0)}, "norm 2"),
])  # fmt: skip
def test_an_impossible_obstacle_is_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        Obstacle(name="crate", **values)  # type: ignore[arg-type]
    assert "\n" not in error.value.line


def test_an_obstacle_of_a_file_is_checked() -> None:
    ball = obstacle_hull(validate(Obstacle, {"name": "ball", "sphere": 0.5, "position": [0, 0, 1]}, "problem.toml"))
    assert ball.radius == 0.5 and ball.vertices.tolist() == [[0, 0, 1]]
    with pytest.raises(SpecError, match="did you mean position"):
        validate(Obstacle, {"name": "ball", "sphere": 0.5, "positon": [0, 0, 1]}, "problem.toml")
