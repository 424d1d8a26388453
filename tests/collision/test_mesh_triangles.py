"""Meshes of several parts have the triangles of their files, although coal numbers their triangles wrongly."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.collision.coal_geometry import load_geometry
from impact_posture.collision.mesh_check import MeshCheck
from impact_posture.collision.shape_corners import mesh_points, mesh_triangles, renumbered
from impact_posture.collision.swept_hull import obstacle_hull
from impact_posture.collision.urdf_shapes import read_urdf_shapes
from impact_posture.config.obstacle import Obstacle
from impact_posture.output.report.drawn_robot import draw_robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.arrays import Array
from tests.collision.test_bad_shapes import arm, mesh, own_cache

__all__ = ["own_cache"]
CUBE = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
# Centers of the parts of the mesh, in m.
PARTS = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.6, 0.0, 0.1))


def collada(path: Path) -> Path:
    """Write a mesh of three cubes with different materials."""
    points = np.concatenate([CUBE + part for part in PARTS])
    numbers = " ".join(map(str, points.ravel()))
    triangles = "".join(
        f'<triangles material="m{k}" count="{len(FACES)}"><input semantic="VERTEX" source="#v" offset="0"/>'
        f"<p>{' '.join(map(str, (FACES + len(CUBE) * k).ravel()))}</p></triangles>"
        for k in range(len(PARTS))
    )
    path.write_text(
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset><up_axis>Z_UP</up_axis>'
        f'</asset><library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" '
        f'count="{points.size}">{numbers}</float_array>'
        f'<technique_common><accessor source="#a" count="{len(points)}" stride="3">'
        '<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>'
        '</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        f'{triangles}</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
        '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene><instance_visual_scene '
        'url="#s"/></scene></COLLADA>'
    )
    return path


def as_coal_reads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.collision.mesh_file.renumbered", lambda count, faces: faces)
    monkeypatch.setattr("impact_posture.collision.mesh_file._READ", {})


@pytest.mark.parametrize("right", [True, False])
def test_the_check_sees_every_part_of_a_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, right: bool) -> None:
    collada(tmp_path / "cubes.dae")
    if not right:
        as_coal_reads_it(monkeypatch)
    shapes = arm(tmp_path, mesh("cubes.dae"))
    (solid,) = [shape.geometry for shape in shapes.geometry.geometryObjects if shape.name == "middle"]
    q, seen = shapes.robot.posture(), []
    middle = np.array([0.0, 0.0, 0.3])
    for part in PARTS:
        # The plate intersects only one part of the mesh.
        plate = obstacle_hull(Obstacle(name="plate", box=(0.02, 0.2, 0.02), position=tuple((middle + part).tolist())))
        seen.append(bool(MeshCheck(shapes.robot, shapes).collisions(q, obstacles=[(plate, pin.SE3.Identity(), ())])))
    assert seen == [True, right, right]
    # With correct triangles, the mesh extends to its farthest corners.
    reach = mesh_points(solid)[mesh_triangles(solid)][..., 0].max()
    assert bool(np.isclose(reach, PARTS[-1][0] + 0.05)) is right
    assert not shapes.warnings


def probes(triangles: Array, shape: coal.BVHModelBase) -> Array:
    """Return for each triangle, shape (n, 3, 3), whether a 10 µm ball at its center touches the mesh."""
    ball, here, touching = coal.Sphere(1e-5), coal.Transform3s(), []
    for center in triangles.mean(axis=1):
        at = coal.Transform3s(np.eye(3), center)
        touching.append(coal.collide(shape, here, ball, at, coal.CollisionRequest(), coal.CollisionResult()) > 0)
    return np.array(touching)


@pytest.mark.parametrize(("name", "changed"), [("go2", 2), ("icub", 1), ("panda", 0), ("talos", 0)])
def test_meshes_of_robots(name: str, changed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot(name)
    described = [shape for shape in read_urdf_shapes(robot)[0] if shape.kind == "mesh"]
    now = [shape.geometry for shape in load_geometry(robot, described).model.geometryObjects]
    as_coal_reads_it(monkeypatch)
    before = [shape.geometry for shape in load_geometry(robot, described).model.geometryObjects]
    different = [
        (a, b) for a, b in zip(now, before, strict=True) if not np.array_equal(mesh_triangles(a), mesh_triangles(b))
    ]
    assert len(different) == changed
    for a, b in different:
        # Both meshes have the same corners and the same hull, but coal leaves out most of the surface of one mesh.
        assert np.array_equal(mesh_points(a), mesh_points(b))
        assert np.array_equal(np.unique(mesh_triangles(a)), np.arange(len(mesh_points(a))))
        surface = mesh_points(a)[mesh_triangles(a)][:: max(1, a.num_tris // 200)]
        assert probes(surface, a).all()
        assert probes(surface, b).mean() < 0.7


@given(st.lists(st.lists(st.integers(3, 30), min_size=1, max_size=4), min_size=1, max_size=3))
def test_parts_of_a_file_are_separated(nodes: list[list[int]]) -> None:
    """The nodes contain several parts.  coal numbers the corners of each part from the first corner of its node."""
    numbered, true, base = [], [], 0
    for parts in nodes:
        node = base
        for count in parts:
            fan = np.array([[0, k, k + 1] for k in range(1, count - 1)])
            numbered.append(fan + node)
            true.append(fan + base)
            base += count
    triangles = renumbered(base, np.concatenate(numbered))
    assert triangles is not None and np.array_equal(triangles, np.concatenate(true))
    assert renumbered(base + 1, np.concatenate(numbered)) is None


def test_the_hull_replaces_parts_that_cannot_be_separated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.collision.mesh_file.renumbered", lambda *_: None)
    collada(tmp_path / "cubes.dae")
    shapes = arm(tmp_path, mesh("cubes.dae"))
    (line,) = shapes.warnings
    assert line.startswith("shape middle is replaced by its convex hull: the parts of ") and line.endswith(
        "export it as one part"
    )
    (solid,) = [shape.geometry for shape in shapes.geometry.geometryObjects if shape.name == "middle"]
    # The hull of the cubes also contains the space between the cubes.
    ball, at = coal.Sphere(0.04), coal.Transform3s(np.eye(3), np.array([0.15, 0.06, 0.0]))
    assert coal.collide(solid, coal.Transform3s(), ball, at, coal.CollisionRequest(), coal.CollisionResult())
    (drawn,) = [s for s in draw_robot(shapes.robot, True).solids if np.ptp(s.points[:, 0]) > 0.5]
    assert np.allclose(np.ptp(drawn.points, axis=0), [0.7, 0.1, 0.2], atol=1e-4)
