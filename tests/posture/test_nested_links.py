"""Links with overlapping hulls: planes in joint coordinates keep their shapes from touching."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impact_posture.collision.joint_planes import JointPlanes, joint_planes
from impact_posture.collision.mesh_check import MeshCheck
from impact_posture.collision.robot_shapes import RobotShapes, load_shapes
from impact_posture.collision.shape_pairs import random_postures
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraints.linear_joints import LinearJoints
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.arrays import Array
from tests.collision.test_bad_shapes import mesh, shaped
from tests.support.constraints import check_expression
from tests.support.urdfs import stl

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
# Inner half width of a channel, thickness of its walls, and half width of the rod in it, in m.
INNER, WALL, ROD = 0.1, 0.02, 0.02


# ---- a rod in a channel -------------------------------------------------------------------------------------------


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    center, size = (np.array(high) + low) / 2, np.array(high) - low
    return np.asarray((CUBE * size + center)[FACES])


def rod_in_channel(folder: Path, turn: Array) -> tuple[Robot, RobotShapes]:
    """A rod that slides by ±12 cm along y and z in a channel along x; channel and rod are rotated together."""
    width = INNER + WALL
    channel = np.concatenate([
        box((-0.15, -width, -WALL), (0.15, width, 0)),
        box((-0.15, -width, 0), (0.15, -INNER, 0.3)),
        box((-0.15, INNER, 0), (0.15, width, 0.3)),
    ])  # fmt: skip
    stl(folder / "channel.stl", channel @ turn.T)
    text = f'<robot name="channel">{shaped("frame", mesh("channel.stl"))}{shaped("slide")}'
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
    rod = shaped("rod", f'<box size="0.2 {2 * ROD} {2 * ROD}"/>')
    (folder / "channel.urdf").write_text(f"{text}{rod}</robot>")
    robot = load_robot(str(folder / "channel.urdf"), armature="none")
    return robot, load_shapes(robot)


def within(robot: Robot, planes: JointPlanes, q: Array) -> bool:
    """Whether a posture satisfies the planes of two bodies."""
    at = [robot.model.idx_qs[robot.joint_id(name)] for name in planes.joints]
    return bool((planes.normals @ q[at] <= planes.bounds).all())


@pytest.mark.parametrize("turn", [np.eye(3), pin.rpy.rpyToMatrix(0.3, 0.2, 0.7)], ids=["upright", "turned"])
def test_a_rod_may_be_in_a_channel_and_not_in_its_walls(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, turn: Array
) -> None:
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    robot, shapes = rod_in_channel(tmp_path, turn)
    assert shapes.hulls_touching == () and shapes.without_shapes == ("slide",) and not len(shapes.pairs)
    (planes,) = shapes.joint_planes
    assert set(planes.bodies) == {"frame", "rod"} and planes.joints == ("y", "z")
    free, allowed = 0, 0
    for q in random_postures(robot, 200):
        gap = float(min(INNER - ROD - abs(q[0]), 0.15 + q[1] - ROD))
        assert bool(MeshCheck(robot, shapes).collisions(q)) is (gap < 0)
        assert gap > 0 or not within(robot, planes, q)
        free, allowed = free + (gap > 0), allowed + within(robot, planes, q)
    assert 100 < free < 190
    assert allowed > 0.7 * free


# ---- robots -------------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("icub", "hextilt"))
@pytest.mark.parametrize("name", ["hextilt", "g1", "icub"])
def test_nested_bodies_keep_apart_and_most_of_their_free_positions(name: str) -> None:
    """Two joints connect bodies such as pelvis and hip of g1; three joints connect the hip bodies of iCub."""
    robot = load_robot(name)
    shapes = load_shapes(robot)
    assert shapes.hulls_touching == () and shapes.joint_planes
    for planes in shapes.joint_planes:
        one, other = ({k for k, body in enumerate(shapes.bodies) if body.name == end} for end in planes.bodies)
        assert one and other and not [pair for pair in shapes.pairs if set(pair) == one | other]
        assert within(robot, planes, robot.posture())
    free, kept = np.zeros((2, len(shapes.joint_planes)), dtype=int)
    for q in random_postures(robot, 200):
        hit = {frozenset(pair) for pair in MeshCheck(robot, shapes).collisions(q)}
        apart = np.array([frozenset(planes.bodies) not in hit for planes in shapes.joint_planes])
        inside = np.array([within(robot, planes, q) for planes in shapes.joint_planes])
        assert not (inside & ~apart).any()
        free, kept = free + apart, kept + inside
    # Most postures collide at the hips of iCub, and the set of collision-free postures is far from convex.
    least = [0.7 if len(planes.joints) == 2 else 0.1 for planes in shapes.joint_planes]
    assert (kept > least * free).all()


def test_bodies_that_nest_and_never_touch_are_free() -> None:
    """The upper legs of HyQ turn inside the hull of the body, but never touch its shapes."""
    shapes = load_shapes(load_robot("hyq"))
    assert shapes.hulls_touching == () and [len(planes.bounds) for planes in shapes.joint_planes] == [0] * 4
    names = [body.name for body in shapes.bodies]
    apart = {frozenset((names[i], names[j])) for i, j in shapes.pairs}
    assert frozenset(("base_link", "lf_upperleg")) not in apart
    assert frozenset(("base_link", "lf_lowerleg")) in apart


# ---- bounds on the joints between two bodies ----------------------------------------------------------------------

WAIST = ("waist_roll_joint", "waist_pitch_joint")


def planes_where(
    touches: Callable[[Array], bool],
    first: str = "waist_yaw_joint",
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> JointPlanes | None:
    """Return planes for two bodies of g1 that touch if ``touches`` is true for the positions of the waist joints."""
    robot = load_robot("g1")
    model = robot.model.copy()
    for name, limits in (ranges or {}).items():
        at = model.idx_qs[robot.joint_id(name)]
        model.lowerPositionLimit[at], model.upperPositionLimit[at] = limits
    robot = replace(robot, model=model)
    last = robot.joint_id(WAIST[-1])

    def touch(data: pin.Data) -> bool:
        # Rotate about x, then about y.
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


@pytest.mark.parametrize("case", ["everywhere", "at the start", "far joints"])
def test_no_planes_where_none_help(case: str) -> None:
    regions = {
        "everywhere": lambda x: True,
        "at the start": lambda x: bool(np.hypot(*x) < 0.1),
        "far joints": lambda x: bool(x[0] > 0.4),
    }
    first = "left_knee_joint" if case == "far joints" else "waist_yaw_joint"
    assert planes_where(regions[case], first) is None


def test_a_joint_without_a_range_stays_where_it_is() -> None:
    def touches(x: Array) -> bool:
        return bool(x[1] > 0.3)

    planes = planes_where(touches, ranges={WAIST[0]: (0.0, 0.0)})
    assert planes is not None and planes.joints == WAIST[1:]
    # If a joint range covers many turns, adjacent points of the grid are too far apart.
    assert planes_where(touches, ranges={WAIST[0]: (-75.4, 75.4)}) is None


def test_shapes_that_touch_nowhere_need_no_plane() -> None:
    planes = planes_where(lambda x: False)
    assert planes is not None and planes.normals.shape == (0, 2) and planes.bounds.shape == (0,)


@given(seed=st.integers(0, 2**32 - 1))
def test_within_the_planes_the_waist_of_g1_does_not_touch(seed: int) -> None:
    robot = load_robot("g1")
    (planes,) = (one for one in load_shapes(robot).joint_planes if one.joints == WAIST)
    constraint, numeric = LinearJoints.apart(robot, planes), Numeric(robot.model)
    assert set(planes.bodies) == {"waist_yaw_link", "torso_link"}
    q = robot.posture()
    at = [robot.model.idx_qs[robot.joint_id(name)] for name in WAIST]
    q[at] = np.random.default_rng(seed).uniform(-0.52, 0.52, 2)
    touching = set(planes.bodies) in [set(pair) for pair in MeshCheck(robot, load_shapes(robot)).collisions(q)]
    assert not (touching and (constraint.value(numeric.at(q)) <= constraint.upper).all())
    check_expression(constraint, robot.model, [q])
