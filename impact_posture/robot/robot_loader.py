"""Load a robot by its name or by the path of a URDF or MJCF."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from impact_posture.config.checked import checked
from impact_posture.config.problem_settings import LoadOptions, RobotSettings, Vector3
from impact_posture.config.table_validation import validate
from impact_posture.errors import (
    InputError,
    JointNotFound,
    PackageNotFound,
    RobotNotFound,
    SpecError,
    UrdfError,
    listed,
)
from impact_posture.robot.armature import armature_warning, set_armature
from impact_posture.robot.inertia_checks import check_any_mass, check_mass_matrix, check_moved_mass, massless_joints
from impact_posture.robot.joint_coupling import couple_limits, coupled, present, with_partners
from impact_posture.robot.model_joints import (
    immovable_joints,
    is_free_flyer,
    joint_index,
    movable_joints,
    q_slice,
    v_slice,
)
from impact_posture.robot.named_postures import ignored_bases, named_postures
from impact_posture.robot.robot import CompiledMjcf, Robot, RobotFiles
from impact_posture.robot.robot_collections import COLLECTIONS, CollectedRobot, collected, names_with
from impact_posture.robot.robot_description import read_description
from impact_posture.robot.robot_spec import RobotSpec, read_spec
from impact_posture.robot.urdf import EXAMPLE_PREFIX, resolve_path, robots_data
from impact_posture.robot.xacro_file import expand_xacro
from impact_posture.system.arrays import Array


def known_robots() -> tuple[str, ...]:
    """Return the names of the robots that need no path, sorted."""
    return tuple(sorted(p.parent.name for p in robots_data().glob("*/robot.toml")))


@checked
def load_robot(robot: str, options: LoadOptions | None = None, **settings: Any) -> Robot:
    """Load a robot by its name or by the path of a URDF, xacro file or MJCF.

    Args:
        robot: One of the forms of :func:`~impact_posture.robot.robot_collections.ways_to_name`.
        options: Options of loading.
        settings: Fields of :class:`~impact_posture.config.problem_settings.LoadOptions`, for example
            ``root="fixed"``.  They replace ``options``.

    Raises:
        RobotNotFound: No robot has this name; the error lists the nearest names.
        UrdfError: The URDF or SRDF cannot be used.
        SpecError: The robot.toml cannot be used.
    """
    options = options or validate(LoadOptions, settings, "load_robot")
    values = {field.name: getattr(options, field.name) for field in fields(LoadOptions)}
    return replace(build_robot(locate(robot, options), options), settings=RobotSettings(robot=robot, **values))


def build_robot(located: Located, options: LoadOptions) -> Robot:
    """Build the robot that a URDF or MJCF and a ``robot.toml`` describe; see :func:`load_robot` for errors."""
    spec, files, source, name, _ = located
    root = options.root or spec.model.root
    described = read_description(files.urdf, root, accept_inertias=spec.model.accept_inertias)
    model, warnings = described.model, described.warnings
    root = "free-flyer" if is_free_flyer(model) else "fixed"
    _check_names(model, source)
    _remount(model, options.mounting, name)
    _override_limits(model, spec, name)
    _check_limits(model, source)
    couplings = described.couplings
    warnings = (*warnings, *couple_limits(model, couplings))
    model.lowerVelocityLimit, model.lowerEffortLimit = -model.upperVelocityLimit, -model.upperEffortLimit
    postures, default = named_postures(described, files.srdf, spec, name)
    postures = {key: coupled(model, couplings, q) for key, q in postures.items()}
    armature_source = set_armature(model, spec, files.srdf, options.armature, name)
    check_any_mass(model, source)
    locked = _named(model, (*spec.model.lock, *options.lock), f"{name} lock")
    if spec.model.lock_massless or options.lock_massless:
        massless = (joint for joint in massless_joints(model) if joint != "root_joint")
        locked = tuple(dict.fromkeys((*locked, *massless)))
    beside = _beside(model) if root == "free-flyer" else ()
    if beside:
        warnings = (*warnings, f"joints that are not attached to the floating base are locked: {listed(beside)}")
        locked = tuple(dict.fromkeys((*locked, *beside)))
    mjcf = None if described.mjcf is None else CompiledMjcf(described.mjcf, model, postures[default])
    locked = with_partners(couplings, locked)
    if locked:
        model, postures = _lock(model, locked, postures, default, name)
    check_moved_mass(model, source)
    warnings = (*warnings, *_immovable(model))
    if root == "fixed":
        warnings = (*warnings, *ignored_bases(spec, files.srdf, default))
    warnings = (*warnings, *armature_warning(model, armature_source, spec.constraints.hold))
    loaded = Robot(
        name=name, source=source, model=model, root=root, postures=postures, default_posture=default, spec=spec,
        locked=locked, armature_source=armature_source, warnings=warnings, couplings=present(couplings, model),
        files=files, mjcf=mjcf,
    )  # fmt: skip
    check_mass_matrix(loaded, source)
    return loaded


def names_a_path(robot: str, folder: Path) -> bool:
    """Return whether ``robot`` is a path (from ``folder``), and not the name of a known or collected robot."""
    if robot.startswith(COLLECTIONS) or robot in known_robots():
        return False
    return robot.endswith((".urdf", ".xml", ".xacro")) or "/" in robot or os.path.isfile(folder / robot)


def from_folder(data: dict[str, object], folder: Path, files: Sequence[str]) -> dict[str, object]:
    """Return a copy of ``data``, the content of a file in ``folder``, with relative paths resolved.

    The key ``robot`` contains a name, a path or a URI, as on the command line.  ``files`` are the other keys whose
    values may be paths.
    """
    data = dict(data)
    for key in files:
        value = data.get(key)
        if isinstance(value, str) and os.path.isfile(folder / value):
            data[key] = str(folder / value)
    robot = data.get("robot")
    if isinstance(robot, str) and names_a_path(robot, folder):
        data["robot"] = str(folder / Path(robot).expanduser())
    folders = data.get("package_dir")
    if isinstance(folders, list):
        data["package_dir"] = [str(folder / str(name)) for name in folders]
    return data


class Located(NamedTuple):
    """Files of a robot before its URDF or MJCF is read.

    Attributes:
        source: Name, path or URI in outputs.
        home: Folder of the file that the user named.
    """

    spec: RobotSpec
    files: RobotFiles
    source: str
    name: str
    home: Path


def locate(robot: str, options: LoadOptions) -> Located:
    """Find the files of a robot by name, path or URI."""
    shipped = robots_data() / robot / "robot.toml"
    if "/" not in robot and os.path.isfile(shipped):
        spec, base = read_spec(shipped), shipped.parent
        text = spec.model.urdf or ""
        source = text if text.startswith(EXAMPLE_PREFIX) else f"impact-posture:{robot}/{text}"
        stored = CollectedRobot(resolve_path(text, base))
        if options.config:
            # The robot.toml of this package provides the values that the user's file leaves out.
            spec, base = read_spec(Path(options.config), over=shipped), Path(options.config).parent
            chosen = resolve_path(spec.model.urdf or text, base)
            if chosen != stored.path:
                stored = CollectedRobot(chosen)
                source = text if (text := spec.model.urdf or "").startswith(EXAMPLE_PREFIX) else str(chosen)
        name = spec.name or robot
    else:
        stored, source = _stored(robot), robot
        config = Path(options.config) if options.config else stored.path.parent / "robot.toml"
        if options.config or (os.path.isfile(config) and not robot.startswith(COLLECTIONS)):
            spec, base = read_spec(config), config.parent
        else:
            spec, base = RobotSpec(), stored.path.parent
        name = spec.name or ""
    urdf = stored.path
    if os.path.exists(urdf) and not (os.path.isfile(urdf) or os.path.isdir(urdf)):
        fault = "is a pipe or a device, which cannot be read more than once"
        raise UrdfError(fault, where=str(urdf), hint="write its content into a regular file")
    folders = tuple(_package_folders(spec, options, base, name or urdf.stem, *stored.folders))
    if urdf.suffix == ".xacro":
        arguments = {**stored.arguments, **spec.model.xacro_args, **(options.xacro_arg or {})}
        urdf = expand_xacro(urdf, arguments, folders, stored.packages)
    elif options.xacro_arg:
        raise InputError("is not a xacro file", where=robot, hint="leave `xacro_arg` out")
    files = RobotFiles(urdf, _srdf_path(spec, options, base, stored.srdf), folders)
    return Located(spec, files, source, name or urdf.stem, stored.path.parent)


def _stored(robot: str) -> CollectedRobot:
    """Return the files of a robot given by a path, a URI or a name in a collection."""
    if robot.startswith(EXAMPLE_PREFIX):
        return CollectedRobot(resolve_path(robot, Path()))
    if robot.startswith(COLLECTIONS):
        return collected(robot)
    if names_a_path(robot, Path()):
        return CollectedRobot(Path(robot).expanduser())
    raise RobotNotFound(robot, [*known_robots(), *names_with(robot)], hint="(or give a path to a URDF or MJCF)")


def _package_folders(spec: RobotSpec, options: LoadOptions, base: Path, name: str, *more: Path) -> Iterator[Path]:
    """Yield the folders for ``package://`` paths: stated folders, ``more``, and ``ROS_PACKAGE_PATH``."""
    ours = (spec.model.package_dirs, base, f"{name} robot.toml [model] package_dirs")
    for folders, start, where in (options.package_dir, Path(), "package_dir"), ours:
        for folder in folders:
            path = start / Path(folder).expanduser()
            if not os.path.isdir(path):
                siblings = sorted(str(Path(folder).with_name(p.name)) for p in path.parent.glob("*") if p.is_dir())
                raise PackageNotFound(folder, siblings, where=where, hint="name an existing folder")
            yield path
    yield from more
    yield from (Path(folder) for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder)


def _srdf_path(spec: RobotSpec, options: LoadOptions, base: Path, stored: str | None) -> Path | None:
    """Return the SRDF of a robot, or ``None``; raise ``UrdfError`` if a stated file does not exist."""
    text = options.srdf or spec.model.srdf or stored
    if text is None:
        return None
    path = resolve_path(text, Path() if options.srdf else base)
    if not os.path.isfile(path):
        raise UrdfError("no such file", where=str(path), hint="check `srdf` or robot.toml [model] srdf")
    return path


def _remount(model: pin.Model, mounting: Mapping[str, Vector3], name: str) -> None:
    """Move joints with their subtrees; the parent links keep their inertias."""
    where = f"{name} mounting"
    for joint, values in mounting.items():
        index = joint_index(model, joint, where)
        offset = np.array(values, dtype=float)
        if offset.shape != (3,) or not np.isfinite(offset).all():
            fault = "is not finite" if offset.shape == (3,) else "does not have three numbers"
            raise InputError(f"the offset of '{joint}' {fault}", where=where, hint="give three, in meters")
        placement = model.jointPlacements[index].copy()
        placement.translation = placement.translation + offset
        model.jointPlacements[index] = placement


def _override_limits(model: pin.Model, spec: RobotSpec, name: str) -> None:
    where = f"{name} robot.toml [limits]"
    lower, upper = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    for joint, (low, high) in spec.limits.position.items():
        if not low < high:
            raise SpecError(f"position limits of '{joint}' are [{low}, {high}]", where=where, hint="lower < upper")
        index = joint_index(model, joint, where)
        if model.nqs[index] != 1:
            fault = f"joint '{joint}' has no position limits"
            raise SpecError(fault, where=where, hint="remove these limits, because the joint turns freely")
        lower[model.idx_qs[index]], upper[model.idx_qs[index]] = low, high
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    for values, kind in ((spec.limits.velocity, "Velocity"), (spec.limits.effort, "Effort")):
        limits = getattr(model, f"upper{kind}Limit").copy()
        for joint, value in values.items():
            limits[model.idx_vs[joint_index(model, joint, where)]] = value
        setattr(model, f"upper{kind}Limit", limits)


def _check_names(model: pin.Model, source: str) -> None:
    """Raise an error if two joints or two links have the same name, because a name must identify them."""
    links = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    for kind, names in (("joints", list(model.names)), ("links", links)):
        name, count = Counter(names).most_common(1)[0] if names else ("", 0)
        if count > 1:
            hint = "rename one. 'universe' is the world, 'root_joint' the free-flyer. Unnamed MJCF parts get numbers"
            raise UrdfError(f"two {kind} have the name '{name}'", where=source, hint=hint)


def _check_limits(model: pin.Model, source: str) -> None:
    swapped = model.lowerPositionLimit > model.upperPositionLimit
    for index in range(1, model.njoints):
        for k in np.flatnonzero(swapped[q_slice(model, index)]) + model.idx_qs[index]:
            limits = f"{model.lowerPositionLimit[k]:g}, {model.upperPositionLimit[k]:g}"
            fault = f"the lower position limit of '{model.names[index]}' is above its upper limit ({limits})"
            raise UrdfError(fault, where=source, hint="swap the limits there, or give robot.toml [limits.position]")


def _beside(model: pin.Model) -> tuple[str, ...]:
    """Return the joints of a floating robot whose parent is the world, such as parts of the scene in an MJCF."""
    return tuple(model.names[k] for k in range(2, model.njoints) if 1 not in model.supports[k])


def _immovable(model: pin.Model) -> list[str]:
    if not (joints := immovable_joints(model)):
        return []
    held = f"joints with equal position limits are held at them: {listed(joints)}"
    state = "state limits in robot.toml [limits.position] (0 … 0 also means that the URDF states none)"
    return [f"{held}; `lock` them if an impact cannot move them, or {state}"]


def _named(model: pin.Model, patterns: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the joints that names or patterns select, without repetition; each pattern must select a joint."""
    known = movable_joints(model)
    selected: dict[str, None] = {}
    for pattern in patterns:
        fitting = [pattern] if pattern in known else [n for n in known if fnmatchcase(n, pattern)]
        if not fitting:
            hint = "(nothing fits this pattern)" if set(pattern) & set("*?[") else ""
            raise JointNotFound(pattern, known, where=where, hint=hint)
        selected.update(dict.fromkeys(fitting))
    return tuple(selected)


def _lock(
    model: pin.Model, locked: Sequence[str], postures: dict[str, Array], default: str, name: str
) -> tuple[pin.Model, dict[str, Array]]:
    ids = [joint_index(model, joint, f"{name} lock") for joint in locked]
    reduced = pin.buildReducedModel(model, ids, postures[default])
    kept = [i for i in range(1, model.njoints) if i not in ids]
    if not kept:
        raise InputError("every joint is locked", where=f"{name} lock", hint="leave at least one joint free")
    kept_q, kept_v = (np.r_[tuple(entries(model, i) for i in kept)] for entries in (q_slice, v_slice))
    reduced.armature = np.array(model.armature)[kept_v]
    return reduced, {key: q[kept_q] for key, q in postures.items()}
