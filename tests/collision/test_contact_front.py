"""The foremost point of a contact link: exact for boxes, cylinders, spheres and capsules, and named in a warning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.collision.contact_front import ContactFront, contact_front
from impact_posture.config.problem_settings import ImpactSettings
from impact_posture.errors import ContactError
from impact_posture.impact.contact_point import BEYOND
from impact_posture.impact.resolved_impact import resolve
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.arrays import Array

ROOT = '<robot name="probe"><link name="base"/>'
MASS = '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
LINK = '<link name="{name}"><inertial>' + MASS + "</inertial>{shape}</link>"
JOINT = (
    '<joint name="{name}_joint" type="{kind}"><parent link="{parent}"/><child link="{name}"/><axis xyz="0 0 1"/>'
    '<origin xyz="{xyz}" rpy="{rpy}"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
)


def shape(text: str, xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{text}</geometry></collision>'


def link(
    name: str, parent: str, shape: str = "", kind: str = "revolute", xyz: str = "0 0 0", rpy: str = "0 0 0"
) -> str:
    return LINK.format(name=name, shape=shape) + JOINT.format(name=name, kind=kind, parent=parent, xyz=xyz, rpy=rpy)


def written(folder: Path, *links: str) -> Robot:
    path = folder / "probe.urdf"
    path.write_text(ROOT + "".join(links) + "</robot>", encoding="utf-8")
    return load_robot(str(path))


def front_of(robot: Robot, direction: Array, held: tuple[str, ...] = (), q: Array | None = None) -> ContactFront:
    result = contact_front(robot, robot.posture() if q is None else q, "hand", (0, 0, 0), direction, held)
    assert result is not None
    return result


TILTED = np.array([1.0, 2.0, 2.0]) / 3
TURN = pin.rpy.rpyToMatrix(0.4, -0.7, 1.1)


def support(kind: str, d: Array) -> float:
    """Return how far a shape of ``SHAPES`` reaches along the unit vector ``d``, m."""
    axis = abs(d[2])
    return {
        "box": float(np.abs(d) @ [0.1, 0.2, 0.3]),
        "sphere": 0.1,
        "cylinder": 0.2 * axis + 0.1 * float(np.hypot(d[0], d[1])),
        "capsule": 0.2 * axis + 0.1,
    }[kind]


SHAPES = {
    "box": '<box size="0.2 0.4 0.6"/>',
    "sphere": '<sphere radius="0.1"/>',
    "cylinder": '<cylinder radius="0.1" length="0.4"/>',
    "capsule": '<capsule radius="0.1" length="0.4"/>',
}


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 0, 1), (0, 0, -1), (0.6, 0, 0.8), tuple(TILTED)])
def test_the_front_of_a_round_or_flat_shape_is_exact(kind: str, direction: tuple[float, ...], tmp_path: Path) -> None:
    """The reach of the front is the support function of the shape, and the front point lies on the shape."""
    rpy = "0.4 -0.7 1.1"
    robot = written(tmp_path, link("hand", "base", shape(SHAPES[kind], "0.3 -0.1 0.2", rpy)))
    d, center = np.array(direction), np.array([0.3, -0.1, 0.2])
    front = front_of(robot, d)
    assert front.reach == pytest.approx(support(kind, TURN.T @ d) + center @ d, abs=1e-9)
    assert np.dot(front.offset, d) == pytest.approx(front.reach, abs=1e-9)
    assert front.link == "hand"
    local = TURN.T @ (np.array(front.offset) - center)
    # The point is not outside the shape, apart from the tolerance of a flat front.
    for other in np.random.default_rng(0).normal(size=(50, 3)):
        other /= np.linalg.norm(other)
        assert local @ other <= support(kind, other) + 6e-4


def test_on_a_flat_front_the_point_is_nearest_to_the_axis_of_the_frame(tmp_path: Path) -> None:
    inside = written(tmp_path, link("hand", "base", shape(SHAPES["box"], "0.05 0.1 0.2")))
    assert front_of(inside, np.array([0, 0, 1.0])).offset == pytest.approx((0, 0, 0.5), abs=1e-9)
    (tmp_path / "b").mkdir()
    beside = written(tmp_path / "b", link("hand", "base", shape(SHAPES["box"], "0.3 0 0.2")))
    assert front_of(beside, np.array([0, 0, 1.0])).offset == pytest.approx((0.2, 0, 0.5), abs=1e-9)


def test_links_that_cannot_move_relative_to_the_contact_belong_to_its_front(tmp_path: Path) -> None:
    ball = shape('<sphere radius="0.05"/>')
    robot = written(
        tmp_path,
        link("hand", "base", shape('<box size="0.1 0.1 0.1"/>')),
        link("palm", "hand", ball, "fixed", "0.2 0 0"),
        link("finger", "palm", ball, "revolute", "0.2 0 0"),
        link("tip", "finger", ball, "revolute", "0.2 0 0"),
    )
    ahead = np.array([1.0, 0, 0])
    assert front_of(robot, ahead) == ContactFront("palm", pytest.approx((0.25, 0, 0)), pytest.approx(0.25))
    assert front_of(robot, ahead, ("finger_joint",)).reach == pytest.approx(0.45)
    assert front_of(robot, ahead, ("tip_joint",)).reach == pytest.approx(0.25)
    # A held joint has the position that the posture states.
    bent = np.array([0.0, np.pi / 2, 0.0])
    both = ("finger_joint", "tip_joint")
    assert front_of(robot, ahead, both).reach == pytest.approx(0.65)
    assert front_of(robot, ahead, both, bent).reach == pytest.approx(0.45)
    assert front_of(robot, np.array([0, 1.0, 0]), both, bent).reach == pytest.approx(0.25)


def resolved(path: str, **settings: object) -> tuple[list[str], tuple[float, ...]]:
    impact = resolve(ImpactSettings(robot=path, frame="hand", **settings))  # type: ignore[arg-type]
    return [line for line in impact.warnings if "a flat surface touches" in line], impact.contact.offset


def test_the_warning_names_the_distance_and_an_option_that_mends_it(tmp_path: Path) -> None:
    robot = written(
        tmp_path, link("hand", "base", shape('<box size="0.1 0.1 0.3"/>', "0 0 0.1"), xyz="0 0 1", rpy="0 0.3 0")
    )
    path = str(tmp_path / "probe.urdf")
    n = tuple(-pin.rpy.rpyToMatrix(0, 0.3, 0) @ [0, 0, 1.0])
    assert robot.settings is not None
    (line,), offset = resolved(path, normal=n)
    assert offset == (0, 0, 0)
    fact = "a flat surface touches hand first, 250 mm beyond the contact point at hand"
    assert line == f"{fact}: give `offset` 0 0 0.25, or `contact_point` front"
    for mended in ({"offset": (0, 0, 0.25)}, {"contact_point": "front"}):
        lines, offset = resolved(path, normal=n, **mended)
        assert not lines and offset == pytest.approx((0, 0, 0.25), abs=1e-9)
    # A normal in the axes of the contact frame gives the same front.
    assert resolved(path, normal=(0, 0, -1), normal_frame="contact", contact_point="front")[1] == pytest.approx(
        offset
    )
    # A distance below ``BEYOND`` is not reported.  A larger distance is reported.
    assert not resolved(path, normal=n, offset=(0, 0, 0.25 - BEYOND + 1e-4))[0]
    assert resolved(path, normal=n, offset=(0, 0, 0.25 - BEYOND - 1e-4))[0]
    with pytest.raises(ContactError, match="contradicts `offset`"):
        resolved(path, normal=n, contact_point="front", offset=(0, 0, 0))


def test_without_shapes_nothing_is_said_and_the_front_is_refused(tmp_path: Path) -> None:
    written(tmp_path, link("hand", "base"))
    path = str(tmp_path / "probe.urdf")
    assert not resolved(path, normal=(0, 0, 1))[0]
    with pytest.raises(ContactError, match="no shapes"):
        resolved(path, normal=(0, 0, 1), contact_point="front")
