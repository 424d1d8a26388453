"""What a robot's names and geometry suggest: feet, tips, fingers, wheels.  Guesses, never certainty."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.robot.robot import Robot
from impact_posture.robot.spec import SupportSpec
from impact_posture.settings import Vector3

Vector = NDArray[np.float64]

# The field's names for parts, as they stand in the URDFs of example-robot-data and their like.
_FOOT = re.compile(r"sole|foot|feet|hoof|paw|toe|ankle", re.I)
_ARM = re.compile(r"(?<!h)arm(?!ature)|shoulder|elbow|wrist|hand|gripper|head|neck", re.I)
_WHEEL = re.compile(r"wheel|caster|track", re.I)
_ROTOR = re.compile(r"rotor|propeller|motor", re.I)
_FINGER = re.compile(r"finger|thumb|gripper|jaw|knuckle|pinky|(?:^|_)(?:index|middle|ring|little|mrl)(?:_|$)", re.I)
_TOOL = re.compile(r"tcp|tool|(?:^|_)ee(?:f|$|_)|end_?effector|grasp|tip$", re.I)
_HAND = re.compile(r"gripper|hand|palm|flange", re.I)
_SENSOR = re.compile(
    r"imu|camera|optical|laser|lidar|radar|sensor|sonar|range|accelero|gyro|fsr|touch|_itb|_led|dh_frame|visual", re.I
)
_FLYING = re.compile(r"fly|copter|drone|uav|aerial|quadrotor|hexarotor|propeller", re.I)

# Feet stand within this part of the robot's height above its lowest point.
_LEVEL = 0.1
# Points of a foot within this distance (m) of its lowest one touch the ground with it.
_PATCH = 2e-3
# A patch narrower than this (m) is a point.
_SOLE = 0.01
# Cosine of the tilt up to which a sole's frame counts as upright: 1°.
_UPRIGHT = float(np.cos(np.radians(1.0)))


def chain(robot: Robot, joint: int) -> list[int]:
    """The joint and its ancestors, the free-flyer left out."""
    found, first = [], 2 if robot.floating else 1
    while joint >= first:
        found.append(joint)
        joint = int(robot.model.parents[joint])
    return found


def _links(robot: Robot, joint: int) -> list[str]:
    """Names of the link frames that move with a joint."""
    return [str(f.name) for f in robot.model.frames if f.parentJoint == joint and f.type == pin.FrameType.BODY]


def _leaves(robot: Robot) -> list[int]:
    model, first = robot.model, 2 if robot.floating else 1
    parents = {int(p) for p in model.parents}
    return [i for i in range(first, model.njoints) if i not in parents]


def _upright(robot: Robot) -> pin.Data:
    """Frames at the default posture with the base where the world is."""
    q, data = robot.posture(), robot.model.createData()
    if robot.floating:
        q[:7] = (0, 0, 0, 0, 0, 0, 1)
    pin.framesForwardKinematics(robot.model, data, q)
    return data


def feet(robot: Robot, named: Sequence[str] = ()) -> tuple[str, ...]:
    """Frames that look like feet: ends of legs that reach the lowest level of the default posture.

    Args:
        robot: The robot.
        named: Links that the SRDF calls end effectors; those of a leg or foot are taken as they are.
    """
    known = tuple(name for name in named if name in robot.frame_names)
    if known:
        return known
    model, data = robot.model, _upright(robot)
    height = {str(f.name): float(data.oMf[i].translation[2]) for i, f in enumerate(model.frames)}
    found: dict[str, bool] = {}
    for joint in _leaves(robot):
        line = chain(robot, joint)
        words = [str(model.names[i]) for i in line] + [n for i in line for n in _links(robot, i)]
        own = [n for n in _links(robot, joint) if not _SENSOR.search(n) and not _ROTOR.search(n)]
        by_name = [n for n in own if _FOOT.search(n)]
        other = (_WHEEL, _FINGER) if by_name else (_WHEEL, _FINGER, _ARM)
        if len(line) < 2 or not own or any(part.search(word) for part in other for word in words):
            continue
        # A sole lies in a foot, an ankle above it.
        best = min(by_name or own, key=lambda n: ("sole" not in n.lower(), round(height[n], 3), own.index(n)))
        found[best] = bool(by_name)
    if any(found.values()):
        found = {name: True for name, named_so in found.items() if named_so}
    else:
        ground = min(height.values())
        level = ground + _LEVEL * (max(height.values()) - ground)
        found = {name: False for name in found if height[name] <= level}
        if len(found) < 2:
            return ()
    return tuple(found)


def tips(robot: Robot, feet: Sequence[str] = ()) -> tuple[str, ...]:
    """All frames that move, likely contact frames first: tools, hands, ends of limbs, feet; joints' frames last."""
    model = robot.model
    leaves = set(_leaves(robot))
    fingers = {i for i in range(1, model.njoints) if _FINGER.search(str(model.names[i]))}
    legs = {int(model.frames[robot.frame_id(foot)].parentJoint) for foot in feet}
    last = (leaves | {int(model.parents[i]) for i in fingers}) - fingers - legs

    def rank(frame: pin.Frame) -> tuple[int, int]:
        name, joint = str(frame.name), int(frame.parentJoint)
        depth = -len(chain(robot, joint))
        if frame.type != pin.FrameType.BODY:
            return 9, depth
        if _SENSOR.search(name) or _WHEEL.search(name) or _ROTOR.search(name):
            return 8, depth
        if name in feet:
            return 4, depth
        if joint not in last or not depth:
            return (5 if joint in fingers else 6), depth
        if _TOOL.search(name):
            return 1, depth
        return (2 if _HAND.search(name) else 3), depth

    # Of the frames on one link the outer one comes later in the URDF.
    moving = [(i, f) for i, f in enumerate(model.frames) if f.parentJoint > 0 and f.name != "root_joint"]
    ordered = sorted(moving, key=lambda entry: (*rank(entry[1]), -entry[0]))
    return tuple(dict.fromkeys(str(frame.name) for _, frame in ordered))


def fingers(robot: Robot) -> tuple[str, ...]:
    """Joints of grippers and hands: what their names say of them, or of a joint before them."""
    names = robot.model.names
    return tuple(
        joint
        for joint in robot.joint_names
        if any(_FINGER.search(str(names[i])) for i in chain(robot, robot.joint_id(joint)))
    )


def base_frame(robot: Robot) -> str:
    """The root link's frame."""
    joint = 1 if robot.floating else 0
    return str(next(f.name for f in robot.model.frames if f.parentJoint == joint and f.type == pin.FrameType.BODY))


def wheels(robot: Robot) -> tuple[str, ...]:
    """Joints of wheels and casters by their names."""
    return tuple(name for name in robot.joint_names if _WHEEL.search(name))


def flies(robot: Robot) -> bool:
    """Whether a name says that the robot flies."""
    return any(_FLYING.search(name) for name in (robot.name, *robot.frame_names))


def support(robot: Robot, frame: str, urdf: Path, *, flat: bool) -> SupportSpec:
    """A foot with its contact point or sole, as far as the URDF's primitive collision shapes tell.

    Args:
        robot: The robot.
        frame: The foot's frame.
        urdf: Where the shapes are.
        flat: Whether a foot without shapes is taken for a surface.
    """
    data, index = _upright(robot), robot.frame_id(frame)
    points = _lowest_points(robot, data, index, urdf)
    if not len(points):
        return SupportSpec(frame=frame, kind="surface" if flat else "point")
    placement = data.oMf[index]
    patch = np.array([placement.actInv(p) for p in points if p[2] <= points[:, 2].min() + _PATCH])
    low, high = patch.min(axis=0), patch.max(axis=0)
    size = (high - low)[:2] / 2
    wide = len(patch) > 2 and size.min() > _SOLE / 2 and placement.rotation[2, 2] > _UPRIGHT
    middle = (low + high) / 2 if wide else patch.mean(axis=0)
    x, y, z = (round(float(v), 4) + 0.0 for v in middle)
    offset: Vector3 = (x, y, z)
    if wide:
        return SupportSpec(
            frame=frame, kind="surface", offset=offset, size=(round(float(size[0]), 4), round(float(size[1]), 4))
        )
    return SupportSpec(frame=frame, kind="surface" if flat else "point", offset=offset)


def _lowest_points(robot: Robot, data: pin.Data, index: int, urdf: Path) -> Vector:
    """Lowest points (world) of the primitive collision shapes that move with a frame; meshes are not opened."""
    model = robot.model
    joint = model.frames[index].parentJoint
    found: list[Vector] = []
    for link in ET.parse(urdf).getroot().iter("link"):
        name = link.get("name", "")
        if not model.existFrame(name, pin.FrameType.BODY):
            continue
        body = model.getFrameId(name, pin.FrameType.BODY)
        if model.frames[body].parentJoint != joint:
            continue
        for collision in link.iter("collision"):
            at = data.oMf[body] * _origin(collision.find("origin"))
            for shape in collision.iterfind("geometry/*"):
                found += _bottom(shape, at)
    return np.array(found).reshape(-1, 3)


def _origin(tag: ET.Element | None) -> pin.SE3:
    xyz, rpy = (_numbers(tag, key) for key in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)


def _numbers(tag: ET.Element | None, key: str) -> Vector:
    words = (tag.get(key) or "").split() if tag is not None else []
    return np.array([float(w) for w in words]) if len(words) == 3 else np.zeros(3)


def _bottom(shape: ET.Element, at: pin.SE3) -> Iterable[Vector]:
    """Points of a shape among which its lowest ones are; none of a mesh."""
    if shape.tag == "sphere":
        return [np.array(at.translation) - [0, 0, float(shape.get("radius", 0))]]
    if shape.tag == "box":
        half = _numbers(shape, "size") / 2
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return [at.act(corner) for corner in signs * half]
    if shape.tag == "cylinder":
        radius, half_length = float(shape.get("radius", 0)), float(shape.get("length", 0)) / 2
        axis = np.array(at.rotation[:, 2])
        down = np.array([0, 0, -1.0]) + axis[2] * axis
        reach = float(np.linalg.norm(down))
        edge = radius * down / reach if reach > 1e-9 else np.zeros(3)
        return [np.array(at.translation) + sign * half_length * axis + edge for sign in (-1, 1)]
    return []
