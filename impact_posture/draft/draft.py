"""Draft a ``robot.toml`` from a URDF and mark every guess."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.collision.foot_shape import support
from impact_posture.config.problem_settings import LoadOptions, Root
from impact_posture.draft.toml_lines import Draft, comment_lines
from impact_posture.errors import InertiaError, InputError, MjcfError, OutputError, UrdfError
from impact_posture.robot import guessed_parts as guess
from impact_posture.robot.model_joints import joint_family
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_collections import COLLECTIONS
from impact_posture.robot.robot_loader import Located, build_robot, known_robots, load_robot, locate
from impact_posture.robot.robot_spec import SCHEMA, ModelSpec, RobotSpec, Support
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.robot.urdf import EXAMPLE_PREFIX, example_robot_data
from impact_posture.system.escape import toml
from impact_posture.system.output_folder import check_name

# Contact poses, each with the least number of joints between base and contact frame for which the draft guesses the
# pose.  The first pose that fits is guessed, which leaves some freedom of motion.
_POSES = ((7, "full"), (6, "aligned"), (4, "position"), (0, "free"))
# Largest speed of a propeller in a draft, Hz.
_SPEED = 100.0
# The draft sets ``com_over_feet`` only if the center of mass is at least this far (m) inside the support polygon.
_LEAST_DEPTH = 0.02
# Feet whose heights differ by less than this value (m) are treated as level.
_UNEVEN = 1e-3


def write_draft(robot: str, options: LoadOptions, out: Path | None, *, force: bool = False) -> tuple[Path, Draft]:
    """Write a commented ``robot.toml`` that can be loaded without changes; return its path and its content.

    ``options`` are data from the user.  The function reads or guesses all other data.  By default, ``out`` is
    ``robot.toml`` beside the URDF or MJCF, or ``./<name>.toml`` for a robot of a collection.

    Raises:
        InputError: The robot is a known name, which has a ``robot.toml`` already.
        OutputError: ``out`` exists and ``force`` is false, or ``out`` cannot be written.
    """
    if robot in known_robots():
        hint = "name a .urdf, or write the differences into a file and give it by `config`"
        raise InputError("has its robot.toml already", where=robot, hint=hint)
    # The empty file os.devnull is read in place of a robot.toml beside the URDF.
    located = locate(robot, replace(options, config=os.devnull))
    in_package = located.source.startswith(COLLECTIONS)
    out = out or (Path(f"{located.files.urdf.stem}.toml") if in_package else located.home / "robot.toml")
    check_name(out)
    if out.exists() and not force:
        raise OutputError("exists", where=str(out), hint="name another file, or `force` to replace it")
    draft = draft_spec(located, options, out.absolute().parent)
    # The temporary file is in the same folder as ``out``, because relative paths in it start from its folder.
    temporary = out.with_name(f".{out.name}-{os.getpid()}")
    try:
        temporary.write_text(draft.text, encoding="utf-8")
        load_robot(robot, LoadOptions(config=str(temporary)))
        if force:
            os.replace(temporary, out)
        else:
            os.link(temporary, out)  # This call fails if another process has made the file in the meantime.
    except OSError as error:
        raise OutputError.unwritable(out, error, "name another file") from None
    finally:
        temporary.unlink(missing_ok=True)
    return out, draft


def draft_spec(located: Located, options: LoadOptions, folder: Path) -> Draft:
    """Return the draft for a URDF, with paths relative to ``folder``."""
    srdf = located.files.srdf or guess.srdf_near(located.home / located.files.urdf.name)
    try:
        robot = _load(located, options, options.root, srdf)
    except UrdfError as error:  # A fixed robot without joints cannot move.
        if options.root or isinstance(error, (MjcfError, InertiaError)):
            raise
        robot = _load(located, options, "free-flyer", srdf)
    ends = guess.srdf_end_effectors(srdf)
    legs = [link for link, words in ends.items() if "leg" in words or "foot" in words]
    feet = guess.feet(robot, legs)
    if options.root:
        root, why = options.root, "as --root says"
    elif robot.mjcf is not None:
        root, why = robot.root, "as in the MJCF"
    else:
        root, why = guess.likely_root(robot, feet, srdf)
    if root != robot.root:
        robot = _load(located, options, root, srdf)
    if root == "fixed":
        feet = ()
    draft = _header(robot, feet)
    draft.lines += ["", "[model]"]
    if srdf is not None and (options.srdf or located.files.srdf is None):
        draft.key("srdf", _path(srdf, folder), "as --srdf says" if options.srdf else "lies near the URDF")
    draft.key("root", root, why, guessed=options.root is None and robot.mjcf is None)
    _model(draft, robot, options, folder)
    _postures(draft, robot)
    carrying = _contact(draft, robot, feet, [link for link in ends if link not in legs])
    # Two feet on legs of six or more joints are assumed to be flat.
    flat = [len(feet) == 2 and len(guess.joints_to(robot, foot)) > 5 for foot in feet]
    supports = [support(robot, foot, flat=level) for foot, level in zip(feet, flat, strict=True)]
    _supports(draft, robot, supports)
    _constraints(draft, robot, supports, carrying)
    _limits(draft, robot)
    _armature(draft, robot, options)
    _propulsion(draft, robot)
    return draft


def _header(robot: Robot, feet: Sequence[str]) -> Draft:
    draft = Draft(
        comment_lines(
            f"Data of {robot.name} that its {_file(robot, 'URDF')} cannot hold, drafted by impact-posture inspect "
            "--write-robot-toml. "
            "GUESS marks values from names and geometry alone: check them before you trust a result. This file is "
            f"read if it is robot.toml in the folder of the {_file(robot, 'URDF')}, or if --config names it."
        )
    )
    draft.lines.append(f'schema = "{SCHEMA}"')
    draft.key("name", robot.name, f"the name of the {_file(robot, 'URDF')}")
    kind, reason = guess.likely_kind(robot, feet)
    draft.key("kind", kind, reason, guessed=True)
    if states := ", ".join(name for name in robot.postures if name != "neutral"):
        default = guess.start_posture(robot)
        only = ", which are beyond joint limits" if default == "neutral" else ""
        chosen = f"the {_file(robot, 'SRDF')} names {states}{only}"
        draft.key("default_posture", default, chosen, guessed=True)
    return draft


def _postures(draft: Draft, robot: Robot) -> None:
    if guess.start_posture(robot) == "neutral" and robot.joint_names:
        base = ("base = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]",) if robot.floating else ()
        draft.note(
            "No posture has a name: optimizations start with all joints at zero or at the nearest limit, often "
            'straight and singular. Write a bent posture here, and default_posture = "start" above the tables:',
            "[postures.start]",
            *base,
            f"joints = {toml(dict.fromkeys(robot.joint_names[:2], 0.5))}",
        )


def _load(located: Located, options: LoadOptions, root: Root | None, srdf: Path | None) -> Robot:
    plain = LoadOptions(armature=options.armature, lock=options.lock, lock_massless=True)
    spec = RobotSpec(model=ModelSpec(root=root, accept_inertias=True))
    return build_robot(located._replace(spec=spec, files=replace(located.files, srdf=srdf)), plain)


def _model(draft: Draft, robot: Robot, options: LoadOptions, folder: Path) -> None:
    if options.package_dir:
        dirs = [_path(Path(name), folder) for name in options.package_dir]
        draft.key("package_dirs", dirs, "as --package-dir says")
    if options.xacro_arg:
        draft.key("xacro_args", dict(options.xacro_arg), "as --xacro-arg says")
    wheels = () if robot.floating else guess.wheels(robot)
    spinning = [joint for link in guess.propellers(robot) for joint in guess.joints_to(robot, link)]
    if options.lock or wheels or spinning:
        reasons = ["as --lock says"] if options.lock else []
        reasons += ["wheels according to their names; the base stands still"] if wheels else []
        reasons += ["propellers according to their names; their spin does not change the impact"] if spinning else []
        guessed = bool(wheels or spinning)
        draft.key("lock", [*options.lock, *wheels, *spinning], ", and ".join(reasons), guessed=guessed)
    massless = [joint for joint in robot.locked if not any(fnmatchcase(joint, p) for p in options.lock)]
    if massless:
        draft.key("lock_massless", True, f"these joints move no mass: {', '.join(massless)}")
    faults = [warning.partition("; accepted")[0] for warning in robot.warnings if "; accepted" in warning]
    if faults:
        why = f"these inertias are impossible, correct the URDF: {'; '.join(faults)}"
        draft.key("accept_inertias", True, why, guessed=True)


def _contact(draft: Draft, robot: Robot, feet: Sequence[str], ends: Sequence[str]) -> Sequence[str]:
    """Add the table ``[contact]`` to the draft; return the joints that move the contact frame."""
    base, fingers = guess.base_frame(robot), guess.fingers(robot)
    legs = {joint for end in (*feet, *guess.propellers(robot)) for joint in guess.joints_to(robot, end)}
    arms: list[str] = []
    for frame in (*ends, *guess.tips(robot, feet)):
        joints = guess.joints_to(robot, frame) if frame in robot.frame_names else []
        if joints and joints[0] not in fingers and joints[0] not in legs and frame not in (*robot.joint_names, *arms):
            arms.append(frame)
    frame = (arms or [base])[0]
    joints = [joint for joint in guess.joints_to(robot, frame) if joint not in fingers]
    if frame == base:
        pose, why = "free", "a push at the base"
    else:
        # A floating base counts as four more joints.
        count = len(joints) + (4 if robot.floating else 0)
        pose, why = next(p for least, p in _POSES if count >= least), f"{len(joints)} joints lead to it"
    draft.lines += ["", "[contact]"]
    others = f"; others: {', '.join(arms[1:4])}" if arms[1:] else ""
    origin = "the SRDF's end effector" if frame in ends else "the end of an arm" if arms else "the base, no arm"
    draft.key("frame", frame, origin + others, guessed=True)
    draft.key("pose", pose, why, guessed=True)
    if robot.floating and frame != base:
        draft.key("frames", {base: "free"}, "for pushes at the base", guessed=True)
    return joints


def _supports(draft: Draft, robot: Robot, feet: Sequence[Support]) -> None:
    if robot.floating and not feet:
        text = "No feet were found, so the robot is assumed to float. If the robot stands, list each foot:"
        draft.note(text, "[[supports]]", 'frame = "FOOT"', 'kind = "point"')
    frames = guess.upright_frames(robot).oMf
    placements = [frames[robot.frame_id(foot.frame)] for foot in feet]
    heights = [at.act(np.array(foot.offset))[2] for at, foot in zip(placements, feet, strict=True)]
    uneven = float(max(heights) - min(heights)) if feet else 0.0
    text = f"; the feet differ by {1e3 * uneven:.2g} mm in height, so compare their shapes"
    differ = text if uneven > _UNEVEN else ""
    for at, foot in zip(placements, feet, strict=True):
        draft.lines += ["", "[[supports]]"]
        draft.key("frame", foot.frame, "a foot according to the SRDF, its name or its height", guessed=True)
        reason = "its shapes are flat below" if any(foot.size) else "one of two feet, on a leg of six joints"
        reason = reason if foot.kind == "surface" else "its shapes are not flat below"
        draft.key("kind", foot.kind, reason, guessed=True)
        if any(foot.offset):
            lowest = f"lowest point of its shapes at the default posture{differ}"
            draft.key("offset", list(foot.offset), lowest, guessed=bool(differ))
        else:
            draft.lines += comment_lines(
                "offset: the origin of the frame, because the foot ends there or has no shape that can be read"
            )
        if any(foot.size):
            tilt = np.degrees(np.arccos(min(1.0, at.rotation[2, 2])))
            flat = "" if tilt < 1 else f"; it is tilted by {tilt:.2g} degrees at the default posture"
            draft.key("size", list(foot.size), f"m, half of the sole, from its shapes{flat}", guessed=bool(flat))


def _support_depth(robot: Robot, feet: Sequence[Support]) -> float:
    """Return the distance of the center of mass from the edges of the support polygon, m; negative outside."""
    model, q = robot.model, robot.posture()
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    center = np.array(pin.centerOfMass(model, data, q))[:2]
    placements = [(data.oMf[robot.frame_id(foot.frame)], foot) for foot in feet]
    corners = [at.act(np.array(corner))[:2] for at, foot in placements for corner in foot.corners]
    edges = polygon_edges(corners)
    return -1.0 if edges is None else float(np.min(edges[1] - edges[0] @ center))


def _constraints(draft: Draft, robot: Robot, feet: Sequence[Support], carrying: Sequence[str]) -> None:
    free = [joint for joint in robot.joint_names if joint not in carrying]
    hold = [joint for joint in free if joint in guess.fingers(robot)]
    keys = Draft()
    if hold:
        keys.key("hold", hold, "fingers and grippers according to their names", guessed=True)
    if robot.floating and not feet:
        keys.key("level_base", True, "it floats, upright", guessed=True)
    if feet:
        depth = _support_depth(robot, feet)
        if depth > _LEAST_DEPTH:
            keys.key("com_over_feet", True, f"{depth:.2g} m inside at the default posture", guessed=True)
            keys.key("com_margin", 0.01, "m, our choice", guessed=True)
        else:
            keys.lines += comment_lines(
                "com_over_feet: the center of mass is not above the feet at the default posture, or the size of the "
                "soles ([[supports]] size) is not known"
            )
    if keys.lines:
        draft.lines += ["", "[constraints]", *keys.lines]
        draft.guesses += keys.guesses


def _limits(draft: Draft, robot: Robot) -> None:
    model, wide = robot.model, []
    for joint in robot.joint_names:
        index = robot.joint_id(joint)
        k = int(model.idx_qs[index])
        turns = joint_family(model.joints[index]) == "revolute"
        if turns and model.upperPositionLimit[k] - model.lowerPositionLimit[k] > 4 * np.pi + 1e-3:
            wide.append(joint)
    if wide:
        draft.note(
            f"The URDF lets these joints turn by more than two turns: {', '.join(wide)}. Narrow limits keep knees "
            "and elbows on their side:",
            "[limits.position]",
            f"{toml(wide[0])} = [-2.0, 2.0]",
        )


def _armature(draft: Draft, robot: Robot, options: LoadOptions) -> None:
    values = {joint: float(robot.armature[robot.model.idx_vs[robot.joint_id(joint)]]) for joint in robot.joint_names}
    if options.armature is not None:
        draft.lines += ["", "[armature]"]
        draft.key("source", robot.armature_source, "name the data sheet here")
        draft.key("joints", values, "kg m^2 (kg for a prismatic joint); values given with --armature")
    elif any(values.values()):
        low, high = min(v for v in values.values() if v), max(values.values())
        source = _file(robot, "rotor_params of the SRDF")
        draft.note(f"Armature: read from the {source}, {low:.3g} to {high:.3g} kg m^2 a joint.")
    elif values:
        draft.note(
            "No armature was found, so it is zero, and H can be wrong by orders of magnitude. Geared motors have an "
            "armature of gear ratio^2 x rotor inertia, kg m^2; write the values of the data sheet:",
            "[armature]",
            "default = 0.01",
            'source = "the data sheet of ..."',
        )


def _propulsion(draft: Draft, robot: Robot) -> None:
    """Add a commented table ``[propulsion]`` if links are named like propellers."""
    links, base = guess.propellers(robot), guess.base_frame(robot)
    if not links or not robot.floating:
        return
    data, gravity = guess.upright_frames(robot), float(np.linalg.norm(robot.model.gravity.linear))
    to_base = data.oMf[robot.frame_id(base)].inverse()
    hubs = {link: to_base * data.oMf[robot.frame_id(link)] for link in links}
    center = np.mean([hub.translation for hub in hubs.values()], axis=0)
    # Propellers next to each other around the center turn in opposite directions.
    around = sorted(links, key=lambda link: np.arctan2(*(hubs[link].translation - center)[1::-1]))
    coefficient = 2 * robot.mass * gravity / len(links) / _SPEED**2
    lines = [
        "[propulsion]", f"frame = {toml(base)}",
        f"thrust_coefficient = {coefficient:.3g}  # N/Hz^2: twice the weight at {_SPEED:g} Hz, our choice",
        "drag_ratio = 0.02  # m, drag moment per thrust", "speed_min = 10.0  # Hz", f"speed_max = {_SPEED:g}  # Hz",
        "time_constant_up = 0.02  # s", "time_constant_down = 0.04  # s", 'source = "the data sheet of ..."',
    ]  # fmt: skip
    for link in links:
        axis = hubs[link].rotation[:, 2] * (-1 if hubs[link].rotation[2, 2] < 0 else 1)
        lines += [
            "", "[[propulsion.rotors]]", f"name = {toml(link)}",
            f"position = {toml(np.round(hubs[link].translation, 6).tolist())}",
            f"direction = {toml(np.round(axis, 6).tolist())}", f"spin = {2 * (around.index(link) % 2) - 1}",
        ]  # fmt: skip
    text = (
        "GUESS: these links are propellers according to their names. Positions and directions (z axes) are from "
        "their frames, spins alternate around the center. Replace all other numbers by the data sheet, and uncomment "
        "the table, so that the thrusts limit the postures:"
    )
    draft.note(text, *lines)
    draft.guesses.append(f"[propulsion], commented: propellers {', '.join(links)} according to their names")


def _file(robot: Robot, otherwise: str) -> str:
    return "MJCF" if robot.mjcf is not None else otherwise


def _path(path: Path, folder: Path) -> str:
    """Return a path as an example-robot-data URI, or relative to ``folder``."""
    path = path.expanduser().resolve()
    if path.is_relative_to(example_robot_data()):
        return EXAMPLE_PREFIX + path.relative_to(example_robot_data()).as_posix()
    return Path(os.path.relpath(path, folder)).as_posix()
