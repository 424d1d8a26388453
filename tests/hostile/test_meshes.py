"""Damaged meshes, and meshes that take too long, are left out with a warning that names the file.

``--hostile-full`` tries twenty times as many meshes.
"""

from __future__ import annotations

import os
import random
import struct
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.collision.mesh_file import UnusableShape, read_mesh, read_meshes
from impact_posture.collision.shape_corners import shape_points
from impact_posture.collision.swept_hull import fit_hull
from impact_posture.collision.urdf_shapes import LinkShape
from impact_posture.output import plot
from tests.hostile.arena import SMALL, judging, strike
from tests.support.urdfs import stl

CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
POINTS = "0 0 0 .1 0 0 0 .1 0 0 0 .1"
INDICES = " ".join(f"{a} {b} {c}" for a, b, c in FACES)
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES
)
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 4\n"
    "property list uchar int vertex_indices\nend_header\n"
    + "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
    + "".join(f"3 {a} {b} {c}\n" for a, b, c in FACES)
)
X3D = (
    '<X3D version="3.0"><Scene><Shape><IndexedFaceSet coordIndex="0 2 1 -1 0 1 3 -1 0 3 2 -1 1 2 3 -1">'
    f'<Coordinate point="{POINTS}"/></IndexedFaceSet></Shape></Scene></X3D>'
)
ONE = '<instance_geometry url="#g"/>'
DAE = (
    '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/><library_geometries>'
    '<geometry id="g"><mesh><source id="p"><float_array id="a" count="12">' + POINTS + "</float_array>"
    '<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>'
    '<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>'
    '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="4">'
    f'<input semantic="VERTEX" source="#v" offset="0"/><p>{INDICES}</p></triangles></mesh></geometry>'
    '</library_geometries><library_nodes><node id="n0">' + ONE + "</node></library_nodes><library_visual_scenes>"
    '<visual_scene id="s"><node id="r">' + ONE + "</node></visual_scene></library_visual_scenes><scene>"
    '<instance_visual_scene url="#s"/></scene></COLLADA>'
)
GLTF = (
    '{"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": '
    '[{"primitives": [{"attributes": {"POSITION": 0}}]}], "accessors": [{"bufferView": 0, "componentType": 5126, '
    '"count": 3, "type": "VEC3"}], "bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36, '
    '"uri": "pipe"}]}'
)


def doubled(times: int) -> str:
    """Return a COLLADA file whose nodes contain their predecessor twice."""
    nodes = "".join(
        f'<node id="n{k}">' + f'<instance_node url="#n{k - 1}"/>' * 2 + "</node>" for k in range(1, times + 1)
    )
    root = f'<node id="r"><instance_node url="#n{times}"/></node>'
    return DAE.replace("</library_nodes>", f"{nodes}</library_nodes>").replace(f'<node id="r">{ONE}</node>', root)


MESHES = {
    "huge face count.ply": PLY.replace("face 4", "face 4294967295"),
    "huge vertex count.ply": PLY.replace("vertex 4", "vertex 4294967295"),
    "huge index.ply": PLY.replace("3 1 2 3", "3 1 2 2147483647"),
    "huge index.x3d": X3D.replace("1 2 3 -1", "1 2 2147483647 -1"),
    "huge index.dae": DAE.replace("1 2 3</p>", "1 2 2147483647</p>"),
    "huge index.obj": OBJ.replace("f 2 3 4", "f 2 3 2147483647"),
    "huge count.stl": b" " * 80 + struct.pack("<I", 0xFFFFFFFF) + bytes(50),
    "instance of itself.dae": DAE.replace(ONE, f'{ONE}<instance_node url="#n0"/>'),
    "nested.dae": DAE.replace('<node id="r">', "<node>" * 200_000 + '<node id="r">').replace(
        "</node></visual_scene>", "</node>" * 200_001 + "</visual_scene>"
    ),
    "doubled 16 times.dae": doubled(16),
    "doubled 40 times.dae": doubled(40),
}


@pytest.fixture
def good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """Return one valid mesh of each format; set a shorter time limit."""
    monkeypatch.setattr("impact_posture.collision.mesh_file._SECONDS", 1.0)
    paths = {
        "stl": stl(tmp_path / "good.stl", CORNERS[np.array(FACES)]),
        **{kind: tmp_path / f"good.{kind}" for kind in ("obj", "ply", "x3d", "dae")},
    }
    for kind, text in (("obj", OBJ), ("ply", PLY), ("x3d", X3D), ("dae", DAE)):
        paths[kind].write_text(text)
    read_meshes(paths.values())
    for path in paths.values():
        assert np.ptp(read_mesh(path).points, axis=0) == pytest.approx(0.1), path
    return paths


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_meshes_made_to_break_their_reader(good: dict[str, Path], tmp_path: Path) -> None:
    paths = [write(tmp_path / name, content) for name, content in MESHES.items()]
    # After each bad mesh, a good mesh is read.
    read_meshes([path for bad in paths for path in (bad, write(bad.with_suffix(".good.obj"), OBJ))])
    with judging() as judge:
        for path in paths:
            assert len(read_mesh(path.with_suffix(".good.obj")).points) == 4
            start = time.monotonic()
            with pytest.raises(UnusableShape) as caught:
                read_mesh(path)
            # A mesh is read only once.
            slow = ["is read twice"] if time.monotonic() > start + 1 else []
            judge(path.name, slow + ([] if str(path) in str(caught.value) else [f"says {caught.value}"]))


@pytest.mark.long
def test_many_slow_meshes(good: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.collision.mesh_file._LEAST_SECONDS", 0.2)
    paths = [write(tmp_path / f"{k}.dae", MESHES["doubled 40 times.dae"]) for k in range(5)]
    last = write(tmp_path / "last.obj", OBJ)
    read_meshes([*paths, last])
    for path, seconds in zip(paths, ("1", "0.5", "0.25", "0.2", "0.2"), strict=True):
        with pytest.raises(UnusableShape, match=rf"takes more than {seconds}\d* s"):
            read_mesh(path)
    assert len(read_mesh(last).points) == 4


def spoiled(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes of a file with one to three random faults."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(data))
        end = min(len(data), at + rng.choice((1, 1, 4, 30)))
        words = (b"", b"2147483647", b"-1", b"4294967295", b"nan", b"1e400", b"\0", b"\xff\xff\xff\xff", b"<", data)
        data = data[:at] + rng.choice((*words, data[at:end] * 1000)) + data[end:]
    return data


def test_random_faults(good: dict[str, Path], tmp_path: Path, hostile_full: bool) -> None:
    rng = random.Random("meshes")
    paths = [
        write(tmp_path / f"{k}.{kind}", spoiled(path.read_bytes(), rng))
        for k in range(20 * (20 if hostile_full else 1))
        for kind, path in good.items()
    ]
    used = 0
    with judging() as judge:
        for first in range(0, len(paths), 50):
            read_meshes(paths[first : first + 50])
            for path in paths[first : first + 50]:
                fault = ""
                try:
                    shape = LinkShape("link", "link", pin.SE3.Identity(), "mesh", (1.0, 1.0, 1.0), path)
                    corners = fit_hull(shape_points(shape.load(5.0).mesh)).vertices
                    used += 1
                    if not np.abs(corners).max() < 6:
                        fault = "has a hull that is too large"
                except UnusableShape as error:
                    fault = "" if str(path) in str(error) else f"says {error}"
                judge(path.name, [fault] if fault else [])
    assert 0.05 < used / len(paths) < 0.9


def with_mesh(folder: Path, name: str, tag: str) -> None:
    """Write a URDF with a mesh, and with boxes as collision shapes."""
    shapes = f'<{tag}><geometry><mesh filename="{name}"/></geometry></{tag}>'
    if tag == "visual":
        shapes += '<collision><geometry><box size="0.05 0.05 0.2"/></geometry></collision>'
    (folder / "mesh.urdf").write_text(SMALL.replace("</inertial>", f"</inertial>{shapes}"))


@pytest.mark.parametrize("name", ["huge index.ply", "mtllib.obj", "buffer.gltf"])
def test_a_robot_without_its_bad_mesh(name: str, arena: Path) -> None:
    os.mkfifo(arena / "pipe")
    write(arena / name, MESHES.get(name) or (GLTF if name.endswith("gltf") else "mtllib pipe\n" + OBJ))
    with_mesh(arena, name, "collision")
    start = time.monotonic()
    outcome = strike(arena, "inspect", "mesh.urdf")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err
    assert time.monotonic() < start + 10
    left_out = [line for line in outcome.err.splitlines() if "is left out" in line]
    assert len(left_out) == 2 and all(name in line for line in left_out), outcome.err


def test_a_report_without_a_bad_mesh(arena: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "FIGURES", {"jump": plot.FIGURES["jump"]})
    write(arena / "bad.ply", MESHES["huge index.ply"])
    with_mesh(arena, "bad.ply", "visual")
    outcome = strike(
        arena, "optimize", "mesh.urdf", "--frame", "tip", "--normal", "1", "0", "0", "--contact-pose", "free",
        "--starts", "1", "--no-codegen", "--format", "png", "--out", "out", "--quiet",
    )  # fmt: skip
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err
    assert "free space" not in outcome.err and (arena / "out" / "result.json").is_file()
    assert "bad.ply crashes its reader" in (arena / "out" / "report.html").read_text()
