"""Bodies in each other's hollows: cuts that lose nothing, and parts that leave the hollows free."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from impact_posture.arrays import Array
from impact_posture.collision.geometry import load_geometry
from impact_posture.collision.hollows import open_hollows
from impact_posture.collision.hull_fit import fit_hull
from impact_posture.collision.joint_planes import JointPlanes, joint_planes
from impact_posture.collision.mesh_check import mesh_collisions
from impact_posture.collision.pairs import Hindrance, hindered, random_postures, touch_of
from impact_posture.collision.parts import divide, triangles_of
from impact_posture.collision.shape_points import shape_points
from impact_posture.collision.shapes import RobotShapes, load_shapes
from impact_posture.collision.swept_hull import SweptHull, separation
from impact_posture.collision.urdf_shapes import read_urdf_shapes
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.nested_links import NestedLinks
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from tests.test_bad_shapes import link, mesh, stl
from tests.test_collision_shapes import outside, surface

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
# Inner half width of a channel, thickness of its walls, half width of the rod in it, m.
INNER, WALL, ROD = 0.1, 0.02, 0.02


def area(triangles: Array) -> Array:
    return np.asarray(np.linalg.norm(np.cross(*np.diff(triangles, axis=1).transpose(1, 0, 2)), axis=1) / 2)


@given(seed=st.integers(0, 2**32 - 1), height=st.floats(-1.5, 1.5), upright=st.booleans())
def test_a_cut_loses_no_point(seed: int, height: float, upright: bool) -> None:
    random = np.random.default_rng(seed)
    # Corners on a grid, so that some of them lie in an upright plane.
    triangles = random.integers(-4, 5, (60, 3, 3)) / 3
    height = round(3 * height) / 3 if upright else height
    axis = np.eye(3)[seed % 3] if upright else random.normal(size=3)
    axis /= np.linalg.norm(axis)
    below, above = divide(triangles, axis, height)
    assert (below @ axis).max(initial=-9) <= height + 1e-12
    assert (above @ axis).min(initial=9) >= height - 1e-12
    assert area(below).sum() + area(above).sum() == pytest.approx(area(triangles).sum(), abs=1e-12)
    # A random point of each triangle is a sum of the corners of a triangle of its side.
    shares = random.dirichlet(np.ones(3), len(triangles))
    for point in np.einsum("nk,nkj->nj", shares, triangles):
        side = below if point @ axis <= height else above
        rows = np.concatenate([side.transpose(0, 2, 1), np.ones((len(side), 1, 3))], axis=1)
        found = np.linalg.pinv(rows) @ np.r_[point, 1]
        apart = np.linalg.norm(np.einsum("nij,nj->ni", rows, found) - np.r_[point, 1], axis=1)
        assert (apart[found.min(axis=1) > -1e-9] < 1e-9).any()


# ---- a rod in a channel -------------------------------------------------------------------------------------------


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    center, size = (np.array(high) + low) / 2, np.array(high) - low
    return np.asarray((CUBE * size + center)[FACES])


def rod_in_channel(folder: Path, turn: Array) -> tuple[Robot, RobotShapes]:
    """A rod that slides by ±12 cm along y and z in a channel along x, turned as a whole."""
    width = INNER + WALL
    channel = np.concatenate([
        box((-0.15, -width, -WALL), (0.15, width, 0)),
        box((-0.15, -width, 0), (0.15, -INNER, 0.3)),
        box((-0.15, INNER, 0), (0.15, width, 0.3)),
    ])  # fmt: skip
    stl(folder / "channel.stl", channel @ turn.T)
    text = f'<robot name="channel">{link("frame", mesh("channel.stl"))}{link("slide")}'
    rpy = " ".join(map(str, pin.rpy.matrixToRpy(turn)))
    for parent, child, origin, axis in (
        ("frame", "slide", turn @ [0, 0, 0.15], "y"),
        ("slide", "rod", (0, 0, 0), "z"),
    ):
        xyz = " ".join(map(str, origin))
        text += (
            f'<joint name="{axis}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy if axis == "y" else "0 0 0"}"/>'
            f'<axis xyz="{"0 1 0" if axis == "y" else "0 0 1"}"/>'
            '<limit lower="-0.12" upper="0.12" effort="1" velocity="1"/></joint>'
        )
    (folder / "channel.urdf").write_text(f'{text}{link("rod", f"""<box size="0.2 {2 * ROD} {2 * ROD}"/>""")}</robot>')
    robot = load_robot(str(folder / "channel.urdf"), armature="none")
    return robot, load_shapes(robot)


def closest(robot: Robot, shapes: RobotShapes, q: Array) -> float:
    """Least distance of two hulls that have to keep apart, m."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    pairs = ((shapes.bodies[i], shapes.bodies[j]) for i, j in shapes.pairs)
    return min(separation(a, data.oMi[a.joint], b, data.oMi[b.joint]).distance for a, b in pairs)


@pytest.mark.parametrize("turn", [np.eye(3), pin.rpy.rpyToMatrix(0.3, 0.2, 0.7)], ids=["upright", "turned"])
def test_a_rod_may_be_in_a_channel_and_not_in_its_walls(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, turn: Array
) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    robot, shapes = rod_in_channel(tmp_path, turn)
    assert shapes.hulls_touching == () and not shapes.warnings
    assert {body.link for body in shapes.bodies} == {"frame", "rod"} and len(shapes.bodies) > 2
    assert all(body.name.startswith(f"{body.link}/") for body in shapes.bodies if body.link == "frame")
    free, allowed = 0, 0
    for q in random_postures(robot, 200):
        gap = float(min(INNER - ROD - abs(q[0]), 0.15 + q[1] - ROD))
        distance = closest(robot, shapes, q)
        # The hulls hold the shapes, so they are never farther apart.
        assert distance <= max(gap, 0) + 1e-6
        assert bool(mesh_collisions(robot, shapes, q)) is (gap < 0)
        if np.array_equal(turn, np.eye(3)):
            # Parts are cut beside the walls, and take in so much of the channel.
            assert distance > gap - 0.03 or gap < 0
        free, allowed = free + (gap > 0), allowed + (distance > 0)
    assert 100 < free < 190
    assert allowed > 0.7 * free


def test_a_rod_that_fills_its_bore_stays_out_of_the_pairs(tmp_path: Path) -> None:
    """A cube inside another: no cut of either frees the inner one, and neither is cut in the end."""
    triangles = CUBE[FACES]
    cubes = [SweptHull(name, name, 0, *fit_hull(scale * CUBE)) for name, scale in (("outer", 1.0), ("inner", 0.9))]
    hollow = {(0, 1): Hindrance([pin.SE3.Identity()] * 5, 5)}
    opened = open_hollows(cubes, hollow, lambda k: (1.0, 0.9)[k] * triangles)
    assert opened.parts == [[cubes[0]], [cubes[1]]]
    assert opened.hindered == {(0, 1)}


# ---- robots -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hyq", "hextilt"])
def test_bodies_of_robots_have_no_hollows_left(name: str) -> None:
    shapes = load_shapes(load_robot(name))
    assert shapes.hulls_touching == ()
    parts = [body for body in shapes.bodies if "/" in body.name]
    assert parts and len({body.name for body in shapes.bodies}) == len(shapes.bodies)
    # Each part has its link's name, and no more parts than allowed.
    for link_name in {body.link for body in parts}:
        assert len([body for body in parts if body.link == link_name]) <= 8


@pytest.mark.parametrize("name", ["hyq", "hextilt"])
def test_parts_hold_their_shapes(name: str) -> None:
    shapes, random = load_shapes(load_robot(name)), np.random.default_rng(0)
    cut = {body.link for body in shapes.bodies if "/" in body.name}
    frames = shapes.robot.model.frames
    for shape in shapes.geometry.geometryObjects:
        if frames[shape.parentFrame].name not in cut:
            continue
        points = surface(shape, random, 200)
        for body in shapes.bodies:
            if body.joint == shape.parentJoint and len(points):
                points = points[_far(body, points)]
        assert not len(points), shape.name


def _far(body: SweptHull, points: Array) -> Array:
    """Tell which points are not in a swept hull."""
    planes = ConvexHull(body.vertices).equations
    near = np.max(points @ planes[:, :3].T + planes[:, 3], axis=1) <= 0
    near[~near] = outside(body, points[~near]) < 1e-6
    return np.asarray(~near)


def test_pelvis_and_hip_are_kept_apart() -> None:
    """The two bodies of g1 that collide at many of its optima, alone, because its other bodies take long."""
    robot = load_robot("g1")
    described = [shape for shape in read_urdf_shapes(robot)[0] if shape.link in ("pelvis", "right_hip_roll_link")]
    shapes = list(load_geometry(robot, described).model.geometryObjects)
    hulls = []
    for shape in shapes:
        points = shape_points(shape.geometry) @ shape.placement.rotation.T + shape.placement.translation
        hulls.append(SweptHull(shape.name, shape.name, shape.parentJoint, *fit_hull(points)))
    touch = touch_of(shapes)
    hollows = hindered(robot, hulls, [(0, 1)], touch)
    assert set(hollows) == {(0, 1)}
    opened = open_hollows(hulls, hollows, lambda k: triangles_of([shapes[k]]))
    assert opened.hindered == set() and sum(map(len, opened.parts)) > 2
    data = robot.model.createData()
    allowed = free = 0
    for q in random_postures(robot, 300):
        pin.forwardKinematics(robot.model, data, q)
        apart = all(
            separation(a, data.oMi[a.joint], b, data.oMi[b.joint]).distance > 0 for a, b in product(*opened.parts)
        )
        touching = touch((0, 1), data)
        assert not (apart and touching)
        free, allowed = free + (not touching), allowed + apart
    # The hulls of the whole bodies allow less than half of them.
    assert free > 200 and allowed > 0.7 * free


# ---- bounds on the joints between two bodies ----------------------------------------------------------------------

WAIST = ("waist_roll_joint", "waist_pitch_joint")


def planes_where(touches: Callable[[Array], bool], first: str = "waist_yaw_joint") -> JointPlanes | None:
    """Planes for bodies of g1 that touch where a function of the positions of the waist says so."""
    robot = load_robot("g1")
    last = robot.joint_id(WAIST[-1])

    def touch(data: pin.Data) -> bool:
        # Rotations about x, then y.
        R = (data.oMi[robot.joint_id("waist_yaw_joint")].inverse() * data.oMi[last]).rotation
        return touches(np.array([np.arctan2(R[2, 1], R[1, 1]), np.arctan2(R[0, 2], R[0, 0])]))

    return joint_planes(robot, ("a", "b"), (robot.joint_id(first), last), touch)


@given(st.lists(st.tuples(st.sampled_from([-0.52, 0.52]), st.sampled_from([-0.52, 0.52]), st.floats(0.05, 0.35)),
                min_size=1, max_size=3))  # fmt: skip
@settings(max_examples=10, deadline=None)
def test_planes_cut_off_where_shapes_touch(corners: list[tuple[float, float, float]]) -> None:
    def touches(x: Array) -> bool:
        return any(np.hypot(*(x - corner[:2])) <= corner[2] for corner in corners)

    planes = planes_where(touches)
    assert planes is not None and planes.joints == WAIST
    random = np.random.default_rng(0).uniform(-0.52, 0.52, (2000, 2))
    inside = (random @ planes.normals.T <= planes.bounds).all(axis=1)
    assert not any(touches(x) for x in random[inside])
    assert (planes.bounds > 0).all() and inside.mean() > 0.5


@pytest.mark.parametrize("case", ["nowhere", "everywhere", "at the start", "far joints"])
def test_no_planes_where_none_help(case: str) -> None:
    regions = {
        "nowhere": lambda x: False,
        "everywhere": lambda x: True,
        "at the start": lambda x: bool(np.hypot(*x) < 0.1),
        "far joints": lambda x: bool(x[0] > 0.4),
    }
    first = "left_knee_joint" if case == "far joints" else "waist_yaw_joint"
    assert planes_where(regions[case], first) is None


@given(seed=st.integers(0, 2**32 - 1))
def test_within_the_planes_the_waist_of_g1_does_not_touch(seed: int) -> None:
    robot = load_robot("g1")
    (planes,) = load_shapes(robot).joint_planes
    constraint, numeric = NestedLinks(robot, planes), Numeric(robot.model)
    assert planes.joints == WAIST and set(planes.bodies) == {"waist_yaw_link", "torso_link"}
    q = robot.posture()
    at = [robot.model.idx_qs[robot.joint_id(name)] for name in WAIST]
    q[at] = np.random.default_rng(seed).uniform(-0.52, 0.52, 2)
    value, jacobian = constraint.evaluate(numeric.at(q))
    touching = set(planes.bodies) in [set(pair) for pair in mesh_collisions(robot, load_shapes(robot), q)]
    assert not (touching and (value <= constraint.upper).all())
    v = np.random.default_rng(seed).normal(size=robot.nv)
    ahead, behind = (constraint.evaluate(numeric.at(pin.integrate(robot.model, q, h * v)))[0] for h in (1e-6, -1e-6))
    np.testing.assert_allclose(jacobian @ v, (ahead - behind) / 2e-6, atol=1e-7)
    tree_q = ca.SX.sym("q", robot.nq)
    symbolic = ca.Function("c", [tree_q], [constraint.symbolic(Tree(robot.model, tree_q), ca.SX(0, 1))])
    np.testing.assert_allclose(np.array(symbolic(q)).ravel(), value, atol=1e-12)
