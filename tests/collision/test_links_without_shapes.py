"""Warnings about links without shapes, and about omitted meshes: on standard error, in result.json and by inspect."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.collision.test_bad_shapes import FACES, TETRAHEDRON
from tests.support.command import run, succeed
from tests.support.urdfs import stl

TWINBOOM = Path(__file__).parent / "twinboom.urdf"
BENT = "{ waist = 0.0, s = -0.5, e = 0.9, boom = 1.4, jib_joint = 0.6 }"
OPTIMIZE = "--frame tip --normal -1 0 0 --contact-pose position --starts 6 --no-codegen --no-report --out out"
BARE = "links without shapes: mast, jib; "


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A planar arm that touches a wall, next to a boom of two links without shapes, which can swing into the wall."""
    shutil.copy(TWINBOOM, tmp_path)
    (tmp_path / "robot.toml").write_text(f'default_posture = "bent"\n[postures.bent]\njoints = {BENT}\n')
    return tmp_path


def test_a_link_without_a_shape_behind_the_wall_is_a_warning(folder: Path) -> None:
    done = succeed("optimize", "twinboom.urdf", *OPTIMIZE.split(), cwd=folder)
    text = " ".join(done.stdout.split())
    assert "no collision among the links that have shapes (2 have none); closest: " in text
    result = json.loads((folder / "out" / "result.json").read_text())
    assert result["collision"]["links_without_shapes"] == ["mast", "jib"]
    behind = "the optimal posture brings link jib behind the plane of the surface"
    for line in (BARE, behind):
        assert done.stderr.count(f"warning: {line}") == 1
        assert sum(warning.startswith(line) for warning in result["warnings"]) == 1
    # Without a surface, no link can be behind the surface, so no warning appears.
    done = run("optimize", "twinboom.urdf", *OPTIMIZE.split(), "--surface", "none", "--force", cwd=folder)
    assert done.returncode == 0 and BARE in done.stderr and behind not in done.stderr


def test_a_shape_for_every_link_needs_no_warning(folder: Path) -> None:
    text = TWINBOOM.read_text()
    for link in ("mast", "jib"):
        head = f'<link name="{link}">'
        shape = '<collision><origin xyz="0.2 0 0"/><geometry><box size="0.2 0.05 0.05"/></geometry></collision>'
        assert head in text
        text = text.replace(head, head + shape)
    (folder / "twinboom.urdf").write_text(text)
    done = run("optimize", "twinboom.urdf", *OPTIMIZE.split(), cwd=folder)
    assert done.returncode == 0 and "no collision; closest: " in " ".join(done.stdout.split())
    assert "shape" not in done.stderr and "behind" not in done.stderr
    assert json.loads((folder / "out" / "result.json").read_text())["collision"]["links_without_shapes"] == []


@pytest.mark.parametrize(("content", "fault"), [
    ("missing", "no mesh 'jib.stl'; correct the path"),
    ("empty", "cannot be read as a mesh, or is empty"),
    ("millimeters", "so it is not in meters"),
])  # fmt: skip
def test_a_mesh_that_is_left_out_is_a_warning(folder: Path, content: str, fault: str) -> None:
    if content != "missing":
        stl(folder / "jib.stl", TETRAHEDRON[FACES] * 1000 if content == "millimeters" else np.zeros((0, 3, 3)))
    head = '<link name="jib">'
    shape = f'{head}<visual><geometry><mesh filename="jib.stl"/></geometry></visual>'
    (folder / "twinboom.urdf").write_text(TWINBOOM.read_text().replace(head, shape))
    for _ in range(2):
        # The second call reads the cache.
        summary = json.loads(run("inspect", "twinboom.urdf", "--json", cwd=folder).stdout)
    done = run("inspect", "twinboom.urdf", cwd=folder)
    solved = run("optimize", "twinboom.urdf", *OPTIMIZE.split(), cwd=folder)
    assert (done.returncode, solved.returncode) == (0, 0)
    result = json.loads((folder / "out" / "result.json").read_text())
    for line, words in (("shape jib is left out: ", fault), (BARE, "")):
        for warnings in (summary["warnings"], result["warnings"]):
            assert [words in warning for warning in warnings if warning.startswith(line)] == [True]
        for errors in (done.stderr, solved.stderr):
            lines = [each for each in errors.splitlines() if each.startswith(f"warning: {line}")]
            assert len(lines) == 1 and words in lines[0]
    assert "left out" not in solved.stdout and not any("left out" in note for note in result["notes"])
