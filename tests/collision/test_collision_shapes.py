"""Collision shapes of robots: hulls that contain all shapes, pairs that must not touch, and mesh collision checks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from impact_posture.collision.mesh_check import MeshCheck
from impact_posture.collision.robot_shapes import load_shapes
from impact_posture.collision.swept_hull import SweptHull, obstacle_hull, separation, transform
from impact_posture.config.obstacle import Obstacle
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.urdf import resolve_path, robots_data
from impact_posture.system.arrays import Array
from tests.collision.test_swept_hull import distance_of_hulls

ROBOTS = ("tilthex_arm", "panda", "solo8", "talos")


@cache
def robot_of(name: str) -> Robot:
    return load_robot(name)


@cache
def check_of(name: str) -> MeshCheck:
    return MeshCheck(robot_of(name), load_shapes(robot_of(name)))


def surface(shape: pin.GeometryObject, random: np.random.Generator, count: int) -> Array:
    """Return points on the surface of a shape in joint axes, computed by independent formulas."""
    solid, unit = shape.geometry, random.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    match solid:
        case coal.Box():
            points = unit / np.abs(unit).max(axis=1)[:, None] * solid.halfSide
        case coal.Sphere():
            points = unit * solid.radius
        case coal.Cylinder():
            ring = unit[:, :2] / np.linalg.norm(unit[:, :2], axis=1)[:, None]
            points = np.c_[ring * solid.radius, random.choice([-1, 1], count) * solid.halfLength]
        case _:
            corners = np.asarray(solid.vertices())
            chosen = random.integers(0, solid.num_tris, count)
            faces = np.array(
                [[triangle[0], triangle[1], triangle[2]] for triangle in map(solid.tri_indices, chosen.tolist())]
            )
            points = np.einsum("nk,nkj->nj", random.dirichlet(np.ones(3), count), corners[faces])
    return np.asarray(points @ shape.placement.rotation.T + shape.placement.translation)


def outside(body: SweptHull, points: Array) -> Array:
    """Return the distances from a swept hull (m) of all points outside the hull without its sweep."""
    if len(body.vertices) > 3:
        planes = ConvexHull(body.vertices).equations
        points = points[np.max(points @ planes[:, :3].T + planes[:, 3], axis=1) > 0]
    return np.array([distance_of_hulls(body.vertices, p[None]) for p in points]) - body.radius


@pytest.mark.parametrize("name", ROBOTS)
def test_a_body_contains_each_shape(name: str) -> None:
    shapes, random = load_shapes(robot_of(name)), np.random.default_rng(0)
    for shape in shapes.geometry.geometryObjects:
        points = surface(shape, random, 30)
        farthest = [
            max(outside(body, points), default=0.0) for body in shapes.bodies if body.joint == shape.parentJoint
        ]
        assert min(farthest) < 1e-6, shape.name
    assert not shapes.warnings
    radii = [body.radius for body in shapes.bodies if len(body.vertices) > 2]
    assert np.median(radii) < 0.0041 and max(radii) < 0.0125
    assert len({body.name for body in shapes.bodies}) == len(shapes.bodies)


@pytest.mark.parametrize("name", ROBOTS)
def test_pairs_leave_out_neighbors_and_links_that_the_srdf_allows_to_touch(name: str) -> None:
    robot = robot_of(name)
    shapes, parents = load_shapes(robot), list(robot.model.parents)
    srdf = pin.GeometryModel(shapes.geometry)
    if robot.spec.model.srdf:
        path = resolve_path(robot.spec.model.srdf, robots_data() / name)
        pin.removeCollisionPairs(robot.model, srdf, str(path), False)
    # The SRDF file does not disable any of the remaining pairs.
    assert len(srdf.collisionPairs) == len(shapes.geometry.collisionPairs)
    for i, j in shapes.pairs:
        a, b = shapes.bodies[i].joint, shapes.bodies[j].joint
        assert a != b and parents[a] != b and parents[b] != a
    # The pairs of bodies correspond exactly to the pairs of shapes that must not touch.
    joints = {(shapes.bodies[i].joint, shapes.bodies[j].joint) for i, j in shapes.pairs}
    named = {body.name: body.joint for body in shapes.bodies}
    nested = (*shapes.hulls_touching, *(planes.bodies for planes in shapes.joint_planes))
    joints |= {(named[a], named[b]) for a, b in nested}
    objects = shapes.geometry.geometryObjects
    of_shapes = {
        (objects[p.first].parentJoint, objects[p.second].parentJoint) for p in shapes.geometry.collisionPairs
    }
    assert {frozenset(pair) for pair in joints} == {frozenset(pair) for pair in of_shapes}


def random_posture(robot: Robot, seed: int) -> Array:
    low, high = (np.clip(limit, -3, 3) for limit in (robot.model.lowerPositionLimit, robot.model.upperPositionLimit))
    q = np.array(pin.randomConfiguration(robot.model, low, high))
    random = np.random.default_rng(seed)
    scalar = [robot.model.idx_qs[i] for i in range(1, robot.model.njoints) if robot.model.nqs[i] == 1]
    q[scalar] = random.uniform(low, high)[scalar]
    return np.asarray(q)


@pytest.mark.parametrize("name", ["panda", "solo8", "talos"])
@given(seed=st.integers(0, 2**32 - 1))
def test_shapes_collide_only_where_hulls_do(name: str, seed: int) -> None:
    robot = robot_of(name)
    shapes, data = load_shapes(robot), robot.model.createData()
    q = random_posture(robot, seed)
    pin.forwardKinematics(robot.model, data, q)
    bodies = [(shapes.bodies[i], shapes.bodies[j]) for i, j in shapes.pairs]
    touching = {
        frozenset((a.joint, b.joint))
        for a, b in bodies
        if separation(a, data.oMi[a.joint], b, data.oMi[b.joint]).distance < 0
    }
    joint = {body.name: body.joint for body in shapes.bodies}
    excused = {frozenset(joint[name] for name in pair) for pair in shapes.hulls_touching}
    joint = {shape.name: shape.parentJoint for shape in shapes.geometry.geometryObjects}
    assert {
        frozenset(joint[name] for name in pair) for pair in MeshCheck(robot, shapes).collisions(q)
    } <= touching | excused


def test_obstacles_and_planes_are_found_by_name() -> None:
    robot = robot_of("panda")
    shapes, q = load_shapes(robot), robot.posture()
    assert MeshCheck(robot, shapes).collisions(q) == []
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    hand = np.array(data.oMf[robot.frame_id("panda_hand")].act(np.array([0.0, 0.0, 0.04])))
    ball = Obstacle(name="ball", sphere=0.02, position=tuple(hand.tolist()))
    far = Obstacle(name="far", box=(0.1, 0.1, 0.1), position=(5.0, 0.0, 0.0))
    hits = MeshCheck(robot, shapes).collisions(
        q, obstacles=[(obstacle_hull(body), pin.SE3.Identity(), ()) for body in (ball, far)]
    )
    assert {name for _, name in hits} == {"ball"}
    assert {shape.partition("[")[0] for shape, _ in hits} <= {"panda_hand", "panda_leftfinger", "panda_rightfinger"}
    # The whole robot is above the ground except parts of its base, which are exempt.
    base = {0}
    ground = SimpleNamespace(name="ground", point=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]), exempt=base)
    assert MeshCheck(robot, shapes).collisions(q, planes=[ground]) == []
    ceiling = SimpleNamespace(name="ceiling", point=hand, normal=np.array([0.0, 0.0, -1.0]), exempt=base)
    above = {shape for shape, plane in MeshCheck(robot, shapes).collisions(q, planes=[ceiling]) if plane == "ceiling"}
    assert "panda_link4" in above and not any(shape.startswith("panda_link0") for shape in above)


@pytest.mark.parametrize("name", ["solo8", "panda"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12)
def test_a_check_of_many_postures_equals_coal_on_each_shape(name: str, seed: int) -> None:
    robot, random = robot_of(name), np.random.default_rng(seed)
    shapes, data, check = load_shapes(robot), robot.model.createData(), check_of(name)
    check.collisions(random_posture(robot, seed + 1))
    q = random_posture(robot, seed)
    collisions = check.collisions(q)
    assert collisions == MeshCheck(robot, shapes).collisions(q)
    pin.forwardKinematics(robot.model, data, q)
    # coal cannot check meshes against swept hulls, so the sweep radius is zero.
    body = replace(shapes.bodies[int(random.integers(len(shapes.bodies)))], name="body", radius=0.0)
    at = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.3)
    normal = random.normal(size=3)
    plane = SimpleNamespace(
        name="plane", point=random.normal(size=3) * 0.2, normal=normal / np.linalg.norm(normal), exempt={1}
    )
    solid, local = body.solid
    walls = [
        ("body", solid, at * local, {2}),
        ("plane", coal.Halfspace(plane.normal, float(plane.normal @ plane.point)), pin.SE3.Identity(), {1}),
    ]
    wanted = [
        (shape.name, wall)
        for shape in shapes.geometry.geometryObjects
        for wall, other, where, exempt in walls
        if shape.parentJoint not in exempt
        and coal.collide(
            shape.geometry, transform(data.oMi[shape.parentJoint] * shape.placement), other, transform(where),
            coal.CollisionRequest(), coal.CollisionResult(),
        )
    ]  # fmt: skip
    assert check.collisions(q, [(body, at, {2})], [plane]) == collisions + wanted


@pytest.mark.parametrize("depth, hit", [(5e-7, False), (2e-6, True), (-1e-9, False)])
def test_a_collision_counts_from_a_micrometer(depth: float, hit: bool) -> None:
    robot = robot_of("tilthex_arm")
    shapes, q = load_shapes(robot), robot.posture()
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    lowest = min(_lowest(shape, data.oMi[shape.parentJoint]) for shape in shapes.geometry.geometryObjects)
    point, normal = np.array([0, 0, lowest + depth]), np.array([0.0, 0.0, 1.0])
    floor = SimpleNamespace(name="floor", point=point, normal=normal, exempt=())
    assert bool(MeshCheck(robot, shapes).collisions(q, planes=[floor])) is hit


def _lowest(shape: pin.GeometryObject, at: pin.SE3) -> float:
    where, solid = at * shape.placement, shape.geometry
    axis = where.rotation[:, 2]
    if isinstance(solid, coal.Sphere):
        return float(where.translation[2] - solid.radius)
    return float(
        where.translation[2] - solid.halfLength * abs(axis[2]) - solid.radius * np.sqrt(max(1 - axis[2] ** 2, 0))
    )


@pytest.mark.parametrize("name", ["icub", "hextilt"])
def test_default_postures_of_robots_with_turned_meshes_are_free(name: str) -> None:
    """Both robots have COLLADA files with y up, but only the URDF of icub needs rotated meshes."""
    robot = robot_of(name)
    shapes = load_shapes(robot)
    assert MeshCheck(robot, shapes).collisions(robot.posture()) == []
    assert any("turned to z up" in line for line in shapes.warnings) is (name == "icub")


def test_overlaps_by_design_are_reported_by_name() -> None:
    shapes = load_shapes(robot_of("hextilt"))
    assert shapes.always_touching == (("flying_arm_5__link_2", "flying_arm_5__link_4"),)
    pairs = {(shapes.bodies[i].name, shapes.bodies[j].name) for i, j in shapes.pairs}
    assert not pairs & {*shapes.always_touching, *shapes.hulls_touching}
    # The check of meshes includes the shapes of nested bodies.
    objects = shapes.geometry.geometryObjects
    checked = {(objects[p.first].name, objects[p.second].name) for p in shapes.geometry.collisionPairs}
    nested = {planes.bodies for planes in shapes.joint_planes}
    assert nested and nested <= checked and not set(shapes.always_touching) & checked and not nested & pairs
