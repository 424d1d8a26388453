"""Guess feet, ends of limbs, fingers and wheels of a robot from names and geometry."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import pinocchio as pin

from impact_posture.config.problem_settings import Root
from impact_posture.errors import PostureError
from impact_posture.robot.model_joints import is_link, joint_range
from impact_posture.robot.named_postures import states_with_base
from impact_posture.robot.robot import Robot
from impact_posture.robot.urdf import read_srdf

# Common names of robot parts, collected from URDFs.
_FOOT = re.compile(r"sole|foot|feet|hoof|paw|toe|ankle", re.I)
_ARM = re.compile(r"(?<!h)arm(?!ature)|shoulder|elbow|wrist|hand|gripper|head|neck", re.I)
_WHEEL = re.compile(r"wheel|caster|track", re.I)
_ROTOR = re.compile(r"rotor|propeller|motor", re.I)
_PROPELLER = re.compile(r"rotor|propeller|(?:^|_)props?(?:_|\d|$)", re.I)
_FINGER = re.compile(r"finger|thumb|gripper|jaw|knuckle|pinky|(?:^|_)(?:index|middle|ring|little|mrl)(?:_|$)", re.I)
_TOOL = re.compile(r"tcp|tool|(?:^|_)ee(?:f|$|_(?![xyz]$))|end_?effector|grasp|tip$", re.I)
_HAND = re.compile(r"gripper|hand|palm|flange", re.I)
_SENSOR = re.compile(
    r"imu|camera|optical|laser|lidar|radar|sensor|sonar|range|accelero|gyro|fsr|touch|_itb|_led|dh_frame|skin|visual",
    re.I,
)
_FLYING = re.compile(r"fly|copter|drone|uav|aerial|quadrotor|hexarotor|propeller", re.I)

# Words in the names of postures from which a search should start, best first.
_STARTS = ("stand", "half_sitting", "home", "ready", "default", "homing", "up")
# Largest height of a foot above the lowest point of the robot, relative to the robot's height.
_LEVEL = 0.1


def chain(robot: Robot, joint: int) -> list[int]:
    """Return the indices of a joint and its ancestors, without the free-flyer."""
    return [int(i) for i in robot.model.supports[joint] if i in joint_range(robot.model)][::-1]


def joints_to(robot: Robot, frame: str) -> list[str]:
    """Return the joints that move a frame, the nearest first."""
    joint = int(robot.model.frames[robot.frame_id(frame)].parentJoint)
    return [str(robot.model.names[i]) for i in chain(robot, joint)]


def _links(robot: Robot, joint: int) -> list[str]:
    return [str(f.name) for f in robot.model.frames if f.parentJoint == joint and is_link(f)]


def _leaves(robot: Robot) -> list[int]:
    return [i for i in joint_range(robot.model) if not len(robot.model.children[i])]


def upright_frames(robot: Robot) -> pin.Data:
    """Return the frame placements at the default posture, with the base upright at the world origin."""
    q, data = robot.posture(), robot.model.createData()
    if robot.floating:
        q[:7] = (0, 0, 0, 0, 0, 0, 1)
    pin.framesForwardKinematics(robot.model, data, q)
    return data


def feet(robot: Robot, named: Sequence[str] = ()) -> tuple[str, ...]:
    """Return frames that are probably feet.

    The function tries three choices: the frames ``named`` by the SRDF, then ends of limbs with a name like "foot",
    then at least two ends of limbs near the lowest height of the default posture.
    """
    known = tuple(name for name in named if name in robot.frame_names)
    if known:
        return known
    model, data = robot.model, upright_frames(robot)
    height = {str(f.name): float(data.oMf[i].translation[2]) for i, f in enumerate(model.frames)}
    called_feet, others = list[str](), list[str]()
    for joint in _leaves(robot):
        line = chain(robot, joint)
        words = [str(model.names[i]) for i in line] + [n for i in line for n in _links(robot, i)]
        links = [n for n in _links(robot, joint) if not _SENSOR.search(n) and not _ROTOR.search(n)]
        by_name = [n for n in links if _FOOT.search(n)]
        excluded = (_WHEEL, _FINGER) if by_name else (_WHEEL, _FINGER, _ARM)
        if len(line) < 2 or not links or any(part.search(word) for part in excluded for word in words):
            continue
        # Prefer the sole.  Without a sole, prefer the lowest link, because an ankle lies above its foot.
        best = min(by_name or links, key=lambda n: ("sole" not in n.lower(), round(height[n], 3), links.index(n)))
        (called_feet if by_name else others).append(best)
    if called_feet:
        return tuple(called_feet)
    ground = min(height.values())
    level = ground + _LEVEL * (max(height.values()) - ground)
    low = tuple(name for name in others if height[name] <= level)
    return low if len(low) > 1 else ()


def tips(robot: Robot, feet: Sequence[str] = ()) -> tuple[str, ...]:
    """Return all moving frames, likely contact frames first: tools, hands, ends of limbs, feet, frames of joints."""
    model = robot.model
    leaves = set(_leaves(robot))
    fingers = {i for i in range(1, model.njoints) if _FINGER.search(str(model.names[i]))}
    legs = {int(model.frames[robot.frame_id(foot)].parentJoint) for foot in feet}
    last = (leaves | {int(model.parents[i]) for i in fingers}) - fingers - legs

    def rank(frame: pin.Frame) -> tuple[int, int]:
        name, joint = str(frame.name), int(frame.parentJoint)
        depth = -len(chain(robot, joint))
        if not is_link(frame):
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

    # Of equally likely frames, prefer the last in the URDF, which is usually farthest out.
    moving = [(i, f) for i, f in enumerate(model.frames) if f.parentJoint > 0 and f.name != "root_joint"]
    ordered = sorted(moving, key=lambda entry: (*rank(entry[1]), -entry[0]))
    return tuple(dict.fromkeys(str(frame.name) for _, frame in ordered))


def fingers(robot: Robot) -> tuple[str, ...]:
    """Return the joints with a name like "finger" or "gripper", and all joints after them.

    The result is empty if no other joint moves, because the robot is then a hand whose fingers receive the impact.
    """
    names = robot.model.names
    moving = tuple(
        joint
        for joint in robot.joint_names
        if any(_FINGER.search(str(names[i])) for i in chain(robot, robot.joint_id(joint)))
    )
    palm_moves = robot.model.frames[robot.frame_id(base_frame(robot))].parentJoint > 0
    return moving if palm_moves or len(moving) < len(robot.joint_names) else ()


def base_frame(robot: Robot) -> str:
    """Return the name of the root link, or of the first link if an MJCF fixes no link to the world."""
    links = [frame for frame in robot.model.frames if frame.type == pin.FrameType.BODY and frame.name != "universe"]
    return str(min(links, key=lambda frame: frame.parentJoint).name)


def wheels(robot: Robot) -> tuple[str, ...]:
    """Return the joints with a name like "wheel" or "caster"."""
    return tuple(name for name in robot.joint_names if _WHEEL.search(name))


def propellers(robot: Robot) -> tuple[str, ...]:
    """Return the links on the base, or on joints of the base, with a name like "rotor" or "prop", if at least three.

    The result is empty for legged robots, whose links with "rotor" in the name are the rotors of motors.
    """
    model, base = robot.model, 1 if robot.floating else 0
    on_base = {base, *(i for i in joint_range(model) if model.parents[i] == base and not len(model.children[i]))}
    frames = (f for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint in on_base)
    named = tuple(str(f.name) for f in frames if _PROPELLER.search(f.name))
    return named if len(named) > 2 and not feet(robot) else ()


def flies(robot: Robot) -> bool:
    """Return whether the name of the robot or of a frame suggests that the robot flies."""
    return any(_FLYING.search(name) for name in (robot.name, *robot.frame_names)) or bool(propellers(robot))


def srdf_near(urdf: Path) -> Path | None:
    """Return the SRDF beside the URDF or in ``../srdf``: the file with the most similar name, or the only file."""
    folders = (urdf.parent, urdf.parent.parent / "srdf")
    near = [path for folder in folders for path in sorted(folder.glob("*.srdf"))]
    fitting = [path for path in near if urdf.stem.startswith(path.stem)]
    if fitting:
        return max(fitting, key=lambda path: len(path.stem)).resolve()
    return near[0].resolve() if len(near) == 1 else None


def srdf_end_effectors(srdf: Path | None) -> Mapping[str, str]:
    """Return the end-effector links in an SRDF → values of all attributes, as lower-case text."""
    tags = read_srdf(srdf).iter("end_effector") if srdf is not None else ()
    return {tag.get("parent_link", ""): " ".join(tag.attrib.values()).lower() for tag in tags}


def likely_root(robot: Robot, feet: Sequence[str], srdf: Path | None) -> tuple[Root, str]:
    """Return the likely root joint, and the reason for this guess."""
    if states := states_with_base(srdf):
        return "free-flyer", f"the SRDF's posture {states[0]} has a base pose"
    if feet:
        return "free-flyer", f"it has feet: {', '.join(feet)}"
    if not robot.joint_names:
        return "free-flyer", "it has no joints"
    if flies(robot):
        return "free-flyer", "its names say that it flies"
    return "fixed", 'nothing says that its base moves; write "free-flyer" if it does'


def likely_kind(robot: Robot, feet: Sequence[str]) -> tuple[str, str]:
    """Return the likely robot type, such as ``humanoid``, and the reason for this guess."""
    if len(feet) in (2, 4):
        return ("quadruped", "four feet") if len(feet) == 4 else ("humanoid", "two feet")
    if robot.floating:
        return ("aerial", "its names say that it flies") if flies(robot) else ("other", "nothing tells")
    return ("mobile", "it has wheels") if wheels(robot) else ("arm", "a fixed root")


def start_posture(robot: Robot) -> str:
    """Return the name of a posture within the limits, preferably for standing or starting."""
    allowed = []
    for name in robot.postures:
        with suppress(PostureError):
            robot.check_posture(robot.posture(name))
            allowed.append(name)

    def rank(name: str) -> int:
        return next((k for k, word in enumerate(_STARTS) if word in name.lower()), len(_STARTS))

    return min((name for name in allowed if name != "neutral"), key=rank, default="neutral")
