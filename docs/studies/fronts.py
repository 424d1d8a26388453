"""Where the default contact frames of the catalogue touch: the foremost point along the axis of the tool."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from docs.studies.core import Request, table
from impact_posture.collision.contact_front import ContactFront, contact_front
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import known_robots, load_robot

# Contact frame → axis of this frame along which the tool points.  A base can be pushed from every side, so it has no
# such axis.
FORWARD = {
    "anymal_kinova": {"j2s6s200_end_effector": "x"},
    "borinot": {"flying_arm_2__ee": "x"},
    "g1": {"right_rubber_hand": "x", "left_rubber_hand": "x"},
    "hextilt": {"flying_arm_5__gripper": "z"},
    "icub": {"r_hand": "x", "l_hand": "x"},
    "kinova": {"j2s6s200_end_effector": "x"},
    "panda": {"panda_hand_tcp": "z"},
    "romeo": {"r_gripper": "x", "l_gripper": "x"},
    "talos": {"gripper_right_base_link": "-z", "gripper_left_base_link": "-z"},
    "tiago": {"hand_palm_link": "x"},
    "tilthex_arm": {"ee": "z"},
    "ur5": {"tool0": "z"},
    "xarm7": {"link_eef": "z"},
    "z1": {"link06": "x"},
}


def front(robot: Robot, frame: str, axis: str) -> ContactFront:
    """Return the foremost point of the contact link along an axis of the contact frame, such as ``-z``."""
    direction = np.eye(3)["xyz".index(axis[-1])] * (-1 if axis.startswith("-") else 1)
    offset = robot.spec.contact.offset_of(frame)
    measured = contact_front(robot, robot.posture(), frame, offset, direction, robot.held)
    assert measured is not None, f"{frame} of {robot.name} has no shapes"
    return measured


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each robot, with the foremost point of the tool and the offset in robot.toml."""
    head = ("robot", "contact frame", "tool along", "foremost point, m", "offset in robot.toml, m", "beyond it, mm")
    yield from table(head, (row for name in known_robots() if request.only in name for row in _rows(name)))


def _rows(name: str) -> Iterator[tuple[str, ...]]:
    robot = load_robot(name)
    contact = robot.spec.contact
    if name not in FORWARD:
        yield name, f"`{contact.frame}`", "–", "depends on the normal", _point(contact.offset), "–"
    for frame, axis in FORWARD.get(name, {}).items():
        measured = front(robot, frame, axis)
        beyond = f"{round(1e3 * measured.reach, 1) + 0.0:.1f}"
        yield name, f"`{frame}`", axis, _point(measured.offset), _point(contact.offset_of(frame)), beyond


def _point(point: tuple[float, float, float]) -> str:
    return " ".join(f"{round(v, 4) + 0.0:g}" for v in point)
