"""A first ``robot.toml`` from a URDF: what can be read is read, what must be guessed is marked as a guess."""

from __future__ import annotations

import os
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.errors import InertiaError, InputError, OutputError, PostureError
from impact_posture.escape import printable, toml
from impact_posture.robot import guess
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import Located, build_robot, known_robots, load_robot, locate
from impact_posture.robot.spec import SCHEMA, ModelSpec, RobotSpec, SupportSpec
from impact_posture.robot.urdf import EXAMPLE_PREFIX, example_robot_data, resolve_path
from impact_posture.settings import LoadOptions, Root

_WIDTH = 100
# Postures to start in, by a part of their name, best first.
_STARTS = ("stand", "half_sitting", "home", "ready", "default", "homing", "up")
# What is held of a frame that so many joints of a fixed robot lead to: some freedom must be left.
_POSES = ((7, "full"), (6, "aligned"), (4, "position"), (0, "free"))
# A center of mass less deep (m) in the support polygon than this is not kept there.
_LEAST_DEPTH = 0.02


@dataclass
class Draft:
    """A ``robot.toml`` in the making.

    Attributes:
        lines: Its text.
        guesses: What is to be checked, one line each.
    """

    lines: list[str] = field(default_factory=list)
    guesses: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The whole file."""
        return "\n".join(self.lines) + "\n"

    def key(self, name: str, value: object, why: str, *, guessed: bool = False) -> None:
        """Write a key and where its value comes from."""
        line, comment = f"{name} = {toml(value)}", _comment(f"GUESS: {why}" if guessed else why)
        beside = f"{line}  {comment[0]}"
        self.lines += [beside] if len(comment) == 1 and len(beside) <= _WIDTH else [*comment, line]
        if guessed:
            self.guesses.append(f"{line}: {why}")

    def note(self, text: str, *example: str) -> None:
        """Write a comment, and lines that a user can put into force."""
        self.lines += ["", *_comment(text), *(f"# {line}" for line in example)]


def write_draft(robot: str, options: LoadOptions, out: Path | None, *, force: bool = False) -> tuple[Path, Draft]:
    """Write a commented ``robot.toml`` that loads without change; return where it is, and what it says.

    Args:
        robot: Path to a ``.urdf``, or ``example-robot-data:<path>``.
        options: What the user says of it; the rest is read or guessed.
        out: The file; by default ``robot.toml`` beside the URDF, or ``./<name>.toml`` of a URDF in a package.
        force: Whether an existing file may be replaced.

    Raises:
        InputError: A robot that is known by name has its ``robot.toml``.
        OutputError: The file exists without ``force``, or cannot be written.
    """
    if robot in known_robots():
        raise InputError(
            "has its robot.toml already",
            where=robot,
            hint="name a .urdf, or write what differs and give --config",
        )
    # An empty file stands for a robot.toml that may lie beside the URDF.
    located = locate(robot, LoadOptions(config=os.devnull))
    in_package = located.source.startswith(EXAMPLE_PREFIX)
    out = out or (Path(f"{located.urdf.stem}.toml") if in_package else located.urdf.parent / "robot.toml")
    if out.exists() and not force:
        raise OutputError("exists", where=str(out), hint="name another file, or --force to replace it")
    draft = draft_spec(located, options, out.absolute().parent)
    # In the same folder, so that relative paths in it lead to the same place.
    beside = out.with_name(f".{out.name}-{os.getpid()}")
    try:
        beside.write_text(draft.text, encoding="utf-8")
        load_robot(robot, LoadOptions(config=str(beside)))
        if force:
            os.replace(beside, out)
        else:
            os.link(beside, out)  # fails on a name that somebody took meanwhile
    except OSError as error:
        words = error.strerror or str(error)
        raise OutputError(f"cannot be written ({words})", where=str(out), hint="name another file") from None
    finally:
        beside.unlink(missing_ok=True)
    return out, draft


def draft_spec(located: Located, options: LoadOptions, folder: Path) -> Draft:
    """Read and guess.

    Args:
        located: The URDF.
        options: What the user says.
        folder: Where relative paths start from.
    """
    srdf = resolve_path(options.srdf, Path()) if options.srdf else _srdf_near(located.urdf)
    robot, faults = _load(located, options, options.root or "fixed", srdf)
    ends = _end_effectors(srdf)
    legs = [link for link, words in ends.items() if "leg" in words or "foot" in words]
    feet = guess.feet(robot, legs)
    root, why = (options.root, "as --root says") if options.root else _root(robot, feet, srdf)
    if root != robot.root:
        robot, faults = _load(located, options, root, srdf)
    if root == "fixed":
        feet = ()
    default = _default_posture(robot)
    draft = Draft(
        _comment(
            f"What the URDF of {robot.name} cannot say, drafted by impact-posture inspect --write-robot-toml. GUESS "
            "marks what is read from names and geometry alone: check it before you trust a result. The file is found "
            "by itself as robot.toml beside the URDF, else by --config."
        )
    )
    draft.lines.append(f'schema = "{SCHEMA}"')
    draft.key("name", robot.name, "the URDF's file name")
    kind, reason = _kind(robot, feet)
    draft.key("kind", kind, reason, guessed=True)
    if states := ", ".join(name for name in robot.postures if name != "neutral"):
        chosen = (
            f"of the SRDF's: {states}" if default != "neutral" else f"the SRDF's leave the joint limits: {states}"
        )
        draft.key("default_posture", default, chosen, guessed=True)
    draft.lines += ["", "[model]"]
    if srdf is not None:
        draft.key("srdf", _path(srdf, folder), "as --srdf says" if options.srdf else "found near the URDF")
    draft.key("root", root, why, guessed=options.root is None)
    _model(draft, robot, options, faults, folder)
    if default == "neutral":
        base = ("base = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]",) if robot.floating else ()
        draft.note(
            "No posture is named: optimizations start with all joints at zero or at the nearest limit, often "
            'straight and singular. Name a bent one here, and default_posture = "start" above the tables:',
            "[postures.start]",
            *base,
            f"joints = {toml(dict.fromkeys(robot.joint_names[:2], 0.5))}",
        )
    carrying = _contact(draft, robot, feet, [link for link in ends if link not in legs])
    _supports(draft, robot, feet, located.urdf)
    _constraints(draft, robot, feet, carrying, located.urdf)
    _limits(draft, robot)
    _armature(draft, robot, options)
    return draft


def _load(located: Located, options: LoadOptions, root: Root, srdf: Path | None) -> tuple[Robot, tuple[str, ...]]:
    """The robot without a robot.toml, and faults of its inertias that had to be accepted."""
    plain = LoadOptions(
        package_dir=options.package_dir, armature=options.armature, lock=options.lock, lock_massless=True
    )

    def load(accept: bool) -> Robot:
        model = ModelSpec(root=root, srdf=None if srdf is None else str(srdf), accept_inertias=accept)
        return build_robot(located._replace(spec=RobotSpec(model=model)), plain)

    try:
        return load(False), ()
    except InertiaError:
        robot = load(True)
    return robot, tuple(w.partition("; accepted")[0] for w in robot.warnings if "; accepted" in w)


def _srdf_near(urdf: Path) -> Path | None:
    """An SRDF beside the URDF or in ``../srdf`` whose name begins the URDF's, or the only one there."""
    folders = (urdf.parent, urdf.parent.parent / "srdf")
    near = [path for folder in folders for path in sorted(folder.glob("*.srdf"))]
    fitting = [path for path in near if urdf.stem.startswith(path.stem)]
    if fitting:
        return max(fitting, key=lambda path: len(path.stem)).resolve()
    return near[0].resolve() if len(near) == 1 else None


def _end_effectors(srdf: Path | None) -> Mapping[str, str]:
    """Links that the SRDF calls end effectors, each with the words about it."""
    tags = ET.parse(srdf).getroot().iter("end_effector") if srdf is not None else ()
    return {tag.get("parent_link", ""): " ".join(tag.attrib.values()).lower() for tag in tags}


def _root(robot: Robot, feet: Sequence[str], srdf: Path | None) -> tuple[Root, str]:
    for state in ET.parse(srdf).getroot().iter("group_state") if srdf is not None else ():
        if any(len((joint.get("value") or "").split()) == 7 for joint in state.iter("joint")):
            return "free-flyer", f"the SRDF's posture {state.get('name')} has a base pose"
    if feet:
        return "free-flyer", f"it has feet: {', '.join(feet)}"
    if guess.flies(robot):
        return "free-flyer", "its names say that it flies"
    return "fixed", 'nothing says that its base moves; "free-flyer" if it does'


def _kind(robot: Robot, feet: Sequence[str]) -> tuple[str, str]:
    if len(feet) in (2, 4):
        return ("quadruped", "four feet") if len(feet) == 4 else ("humanoid", "two feet")
    if robot.floating:
        return ("aerial", "its names say that it flies") if guess.flies(robot) else ("other", "nothing tells")
    return ("mobile", "it has wheels") if guess.wheels(robot) else ("arm", "a fixed root")


def _default_posture(robot: Robot) -> str:
    """A named posture within the limits, one to stand or start in before others."""
    able = []
    for name in robot.postures:
        try:
            robot.check_posture(robot.posture(name))
        except PostureError:
            continue
        able.append(name)

    def rank(name: str) -> int:
        return next((k for k, word in enumerate(_STARTS) if word in name.lower()), len(_STARTS))

    return min((name for name in able if name != "neutral"), key=rank, default="neutral")


def _model(draft: Draft, robot: Robot, options: LoadOptions, faults: Sequence[str], folder: Path) -> None:
    if options.package_dir:
        dirs = [_path(Path(name), folder) for name in options.package_dir]
        draft.key("package_dirs", dirs, "as --package-dir says")
    wheels = () if robot.floating else guess.wheels(robot)
    if options.lock or wheels:
        given = "as --lock says" if options.lock else ""
        why = ", and ".join(filter(None, (given, "wheels by their names, the base stands still" if wheels else "")))
        draft.key("lock", [*options.lock, *wheels], why, guessed=bool(wheels))
    massless = [joint for joint in robot.locked if not any(fnmatchcase(joint, p) for p in options.lock)]
    if massless:
        draft.key("lock_massless", True, f"these joints move no mass: {', '.join(massless)}")
    if faults:
        why = f"no rigid body has these inertias, correct the URDF: {'; '.join(faults)}"
        draft.key("accept_inertias", True, why, guessed=True)


def _contact(draft: Draft, robot: Robot, feet: Sequence[str], ends: Sequence[str]) -> Sequence[str]:
    """Write the contact's table; return the joints that lead to its frame."""
    base, fingers = guess.base_frame(robot), guess.fingers(robot)
    legs = {joint for foot in feet for joint in _joints_to(robot, foot)}
    arms: list[str] = []
    for frame in (*ends, *guess.tips(robot, feet)):
        joints = _joints_to(robot, frame) if frame in robot.frame_names else []
        if joints and joints[0] not in fingers and joints[0] not in legs and frame not in (*robot.joint_names, *arms):
            arms.append(frame)
    frame = (arms or [base])[0]
    joints = [joint for joint in _joints_to(robot, frame) if joint not in fingers]
    if frame == base:
        pose, why = "free", "a push at the base"
    else:
        # A floating base adds its own freedom.
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


def _supports(draft: Draft, robot: Robot, feet: Sequence[str], urdf: Path) -> None:
    if robot.floating and not feet:
        text = "No feet were found: it is taken to float. If it stands, list each foot:"
        draft.note(text, "[[supports]]", 'frame = "FOOT"', 'kind = "point"')
    for foot, spec in zip(feet, _foot_specs(robot, feet, urdf), strict=True):
        draft.lines += ["", "[[supports]]"]
        draft.key("frame", foot, "a foot by the SRDF, its name or its height", guessed=True)
        reason = "a flat collision shape" if any(spec.size) else "one of two feet, on a leg of six joints"
        reason = reason if spec.kind == "surface" else "no flat collision shape"
        draft.key("kind", spec.kind, reason, guessed=True)
        if any(spec.offset):
            draft.key("offset", list(spec.offset), "lowest of its collision shapes at the default posture")
        else:
            draft.lines += _comment("offset: its shape is a mesh (not opened) or none, so the frame's origin touches")
        if any(spec.size):
            draft.key("size", list(spec.size), "the sole, from its collision shapes")


def _foot_specs(robot: Robot, feet: Sequence[str], urdf: Path) -> list[SupportSpec]:
    flat = len(feet) == 2
    return [guess.support(robot, f, urdf, flat=flat and len(_joints_to(robot, f)) > 5) for f in feet]


def _constraints(draft: Draft, robot: Robot, feet: Sequence[str], carrying: Sequence[str], urdf: Path) -> None:
    mimics = {j.get("name") for j in ET.parse(urdf).getroot().iter("joint") if j.find("mimic") is not None}
    free = [joint for joint in robot.joint_names if joint not in carrying]
    hold = [joint for joint in free if joint in mimics or joint in guess.fingers(robot)]
    keys = Draft()
    if hold:
        keys.key("hold", hold, "fingers and grippers by their names, joints that mimic others", guessed=True)
    if robot.floating and not feet:
        keys.key("level_base", True, "it floats, upright", guessed=True)
    if feet:
        depth = _depth(robot, _foot_specs(robot, feet, urdf))
        if depth > _LEAST_DEPTH:
            keys.key("com_over_feet", True, f"at the default posture it is {depth:.2g} m inside", guessed=True)
            keys.key("com_margin", 0.01, "m, our choice", guessed=True)
        else:
            keys.lines += _comment(
                "com_over_feet: the center of mass is not above the feet at the default posture, or the size of the "
                "soles ([[supports]] size) is not known"
            )
    if keys.lines:
        draft.lines += ["", "[constraints]", *keys.lines]
        draft.guesses += keys.guesses


def _depth(robot: Robot, feet: Sequence[SupportSpec]) -> float:
    """How far the center of mass lies inside the support polygon, m; below zero outside or without a polygon."""
    from scipy.spatial import ConvexHull, QhullError

    model, q = robot.model, robot.posture()
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    center = np.array(pin.centerOfMass(model, data, q))[:2]
    signs = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
    corners = [
        data.oMf[robot.frame_id(foot.frame)].act(foot.offset + sign * np.array([*foot.size, 0.0]))[:2]
        for foot in feet
        for sign in signs
    ]
    try:
        hull = ConvexHull(np.array(corners))
    except QhullError:
        return -1.0
    return -float(np.max(hull.equations[:, :2] @ center + hull.equations[:, 2]))


def _limits(draft: Draft, robot: Robot) -> None:
    model, wide = robot.model, []
    for joint in robot.joint_names:
        index = robot.joint_id(joint)
        k = int(model.idx_qs[index])
        turns = model.nqs[index] == 1 and "JointModelR" in model.joints[index].shortname()
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
        draft.key("joints", values, "kg m^2 (kg for a prismatic joint), as --armature says")
    elif any(values.values()):
        low, high = min(v for v in values.values() if v), max(values.values())
        draft.note(f"Armature: read from the SRDF's rotor_params, {low:.3g} to {high:.3g} kg m^2 a joint.")
    else:
        draft.note(
            "No armature was found, hence zero, and H can be wrong by orders of magnitude. Geared motors have gear "
            "ratio^2 x rotor inertia, kg m^2; write the data sheet's:",
            "[armature]",
            "default = 0.01",
            'source = "the data sheet of ..."',
        )


def _joints_to(robot: Robot, frame: str) -> list[str]:
    """The joints that move a frame, the nearest first."""
    joint = int(robot.model.frames[robot.frame_id(frame)].parentJoint)
    return [str(robot.model.names[i]) for i in guess.chain(robot, joint)]


def _path(path: Path, folder: Path) -> str:
    """A path as the file writes it: in example-robot-data, or from the file's folder."""
    path = path.expanduser().resolve()
    if path.is_relative_to(example_robot_data()):
        return EXAMPLE_PREFIX + path.relative_to(example_robot_data()).as_posix()
    return Path(os.path.relpath(path, folder)).as_posix()


def _comment(text: str) -> list[str]:
    # What a name may hold must not end the comment.
    text = printable(text)
    return textwrap.wrap(
        text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False, break_on_hyphens=False
    )
