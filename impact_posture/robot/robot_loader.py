"""From a robot's name, or a path to a URDF, to a :class:`Robot`."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from impact_posture.errors import InputError, JointNotFound, PackageNotFound, RobotNotFound, SpecError, UrdfError
from impact_posture.robot.armature import armature_warning, set_armature
from impact_posture.robot.inertia_checks import check_mass_matrix, check_moved_mass, massless_joints
from impact_posture.robot.robot import Robot, Vector
from impact_posture.robot.spec import RobotSpec, read_spec
from impact_posture.robot.urdf import (
    EXAMPLE_PREFIX,
    build_model,
    example_models,
    example_robot_data,
    joint_index,
    resolve_path,
    robots_data,
)
from impact_posture.settings import LoadOptions, RobotSettings, Root, Vector3
from impact_posture.tables import validate


def known_robots() -> tuple[str, ...]:
    """Names of the robots that can be given without a path, sorted."""
    return tuple(sorted(p.parent.name for p in robots_data().glob("*/robot.toml")))


def load_robot(robot: str, options: LoadOptions | None = None, **settings: Any) -> Robot:
    """Load a robot by known name, by path to a ``.urdf``, or by ``example-robot-data:<path below robots/>``.

    Args:
        robot: The name, path or URI.
        options: How it is loaded.
        settings: Fields of :class:`~impact_posture.settings.LoadOptions` instead, such as ``root="fixed"``.

    Raises:
        RobotNotFound: With the nearest names.
        UrdfError: The URDF or SRDF cannot be used.
        SpecError: The robot.toml cannot be used.
    """
    options = options or validate(LoadOptions, settings, "load_robot")
    given = {field.name: getattr(options, field.name) for field in fields(LoadOptions)}
    return replace(build_robot(locate(robot, options), options), settings=RobotSettings(robot=robot, **given))


def build_robot(located: Located, options: LoadOptions) -> Robot:
    """Build the robot that a URDF and a ``robot.toml`` describe.

    Raises:
        ImpactPostureError: As :func:`load_robot`.
    """
    spec, urdf, source, base, name = located
    root: Root = options.root or spec.model.root
    _check_package_dirs(options.package_dir, Path(), "package_dir")
    _check_package_dirs(spec.model.package_dirs, base, f"{name} robot.toml [model] package_dirs")
    model, warnings = build_model(urdf, free_flyer=root == "free-flyer", accept_inertias=spec.model.accept_inertias)
    _remount(model, options.mounting, name)
    srdf = _srdf(spec, options, base)
    postures = _srdf_postures(model, srdf, spec) | _toml_postures(model, spec, root, name)
    _override_limits(model, spec, name)
    default = spec.default_posture or next(iter(postures), "neutral")
    postures.setdefault("neutral", _neutral(model))
    if default not in postures:
        raise SpecError(
            f"default_posture '{default}' does not exist", where=name, hint=f"one of: {', '.join(postures)}"
        )
    armature_source = set_armature(model, spec, srdf, options.armature, name)
    locked = _named(model, (*spec.model.lock, *options.lock), f"{name} lock")
    if spec.model.lock_massless or options.lock_massless:
        massless = (joint for joint in massless_joints(model) if joint != "root_joint")
        locked = tuple(dict.fromkeys((*locked, *massless)))
    if locked:
        model, postures = _lock(model, locked, postures, default, name)
    check_moved_mass(model, source)
    if root == "fixed":
        warnings = (*warnings, *_bases_left_out(spec, srdf, default))
    warnings = (*warnings, *armature_warning(model, armature_source, spec.constraints.hold))
    loaded = Robot(
        name=name,
        source=source,
        model=model,
        root=root,
        postures=postures,
        default_posture=default,
        spec=spec,
        locked=locked,
        armature_source=armature_source,
        warnings=warnings,
    )
    check_mass_matrix(model, postures[default], loaded.tangent_names, source, default)
    return loaded


def _check_package_dirs(folders: Sequence[str], base: Path, where: str) -> None:
    for folder in folders:
        path = base / Path(folder).expanduser()
        if not path.is_dir():
            siblings = sorted(str(Path(folder).with_name(p.name)) for p in path.parent.glob("*") if p.is_dir())
            raise PackageNotFound(folder, siblings, where=where, hint="name an existing folder")


def names_a_path(robot: str, folder: Path) -> bool:
    """Whether ROBOT is a path (from ``folder``) and not a known name or an example-robot-data URI."""
    if robot.startswith(EXAMPLE_PREFIX) or robot in known_robots():
        return False
    return robot.endswith((".urdf", ".xml", ".xacro")) or "/" in robot or (folder / robot).is_file()


def from_folder(data: dict[str, object], folder: Path, files: Sequence[str]) -> dict[str, object]:
    """Let the paths in a file's content start from the file's folder.

    Args:
        data: Of a file that names a ``robot`` as the command line does; not changed.
        folder: Where the file lies.
        files: Keys that may name files.
    """
    data = dict(data)
    for key in files:
        value = data.get(key)
        if isinstance(value, str) and (folder / value).is_file():
            data[key] = str(folder / value)
    robot = data.get("robot")
    if isinstance(robot, str) and names_a_path(robot, folder):
        data["robot"] = str(folder / Path(robot).expanduser())
    folders = data.get("package_dir")
    if isinstance(folders, list):
        data["package_dir"] = [str(folder / str(name)) for name in folders]
    return data


class Located(NamedTuple):
    """What is known of a robot before its URDF is read: the folder is where relative paths start from."""

    spec: RobotSpec
    urdf: Path
    source: str
    folder: Path
    name: str


def locate(robot: str, options: LoadOptions) -> Located:
    """Find the files of a robot that is given by name, path or URI."""
    own = robots_data() / robot / "robot.toml"
    if "/" not in robot and own.is_file():
        spec, base = read_spec(own), own.parent
        text = spec.model.urdf or ""
        source = text if text.startswith(EXAMPLE_PREFIX) else f"impact-posture:{robot}/{text}"
        urdf = resolve_path(text, base)
        if options.config:
            # What the user's file does not say stays as the catalogue says it.
            spec, base = read_spec(Path(options.config), over=own), Path(options.config).parent
            found = resolve_path(spec.model.urdf or text, base)
            if found != urdf:
                urdf = found
                source = text if (text := spec.model.urdf or "").startswith(EXAMPLE_PREFIX) else str(urdf)
        return Located(spec, urdf, source, base, spec.name or robot)
    if robot.startswith(EXAMPLE_PREFIX):
        urdf, source = resolve_path(robot, Path()), robot
    elif names_a_path(robot, Path()):
        urdf = Path(robot).expanduser()
        source = robot
    else:
        listed = list(known_robots())
        shipped = [EXAMPLE_PREFIX + p for p in example_models() if robot.casefold() in Path(p).stem.casefold()]
        raise RobotNotFound(robot, [*listed, *shipped], hint="(or give a path to a .urdf)")
    config = Path(options.config) if options.config else urdf.parent / "robot.toml"
    if options.config or (config.is_file() and EXAMPLE_PREFIX not in source):
        spec = read_spec(config)
        base = config.parent
    else:
        spec, base = RobotSpec(), urdf.parent
    return Located(spec, urdf, source, base, spec.name or urdf.stem)


def _srdf(spec: RobotSpec, options: LoadOptions, base: Path) -> Path | None:
    text = options.srdf or spec.model.srdf
    if text is None:
        return None
    path = resolve_path(text, Path() if options.srdf else base)
    if not path.is_file():
        raise UrdfError("no such file", where=str(path), hint="check `srdf` or robot.toml [model] srdf")
    return path


def _srdf_postures(model: pin.Model, srdf: Path | None, spec: RobotSpec) -> dict[str, Vector]:
    if srdf is None:
        return {}
    try:
        pin.loadReferenceConfigurations(model, str(srdf), False)
    except Exception as error:  # Pinocchio's own parser raises what its XML library raises.
        raise UrdfError(f"is no SRDF ({error})", where=str(srdf), hint="correct the SRDF") from None
    states = {item.key(): np.array(item.data(), dtype=float) for item in model.referenceConfigurations}
    return {name: pin.normalize(model, q) for name, q in states.items() if name not in spec.postures}


def _toml_postures(model: pin.Model, spec: RobotSpec, root: Root, name: str) -> dict[str, Vector]:
    result = {}
    for key, posture in spec.postures.items():
        q = np.array(pin.neutral(model), dtype=float)
        if posture.base is not None and spec.model.root != "free-flyer" and root != "free-flyer":
            raise SpecError(
                f"posture '{key}' gives a base pose, but the root is fixed",
                where=name,
                hint='remove it, or write root = "free-flyer" in [model]',
            )
        # A floating robot that --root bolts down keeps its postures; what is left of their base is a warning.
        if posture.base is not None and root == "free-flyer":
            _check_base(posture.base, f"{name} posture '{key}'")
            q[:7] = posture.base
        for joint, value in posture.joints.items():
            index = joint_index(model, joint, f"{name} posture '{key}'")
            first = model.idx_qs[index]
            if model.nvs[index] != 1:
                raise SpecError(
                    f"posture '{key}': joint '{joint}' has {model.nvs[index]} degrees of freedom, not one number",
                    where=name,
                    hint="give it in an SRDF",
                )
            if not np.isfinite(value):
                raise SpecError(f"posture '{key}': joint '{joint}' is {value}", where=name, hint="give a number")
            if model.nqs[index] == 2:
                q[first : first + 2] = np.cos(value), np.sin(value)
            else:
                q[first] = value
        result[key] = np.asarray(pin.normalize(model, q))
    return result


def _bases_left_out(spec: RobotSpec, srdf: Path | None, default: str) -> tuple[str, ...]:
    """Say whose base pose a fixed root leaves out: the robot then stands at the world's origin, along its axes."""
    states = ET.parse(srdf).getroot().iter("group_state") if srdf is not None else ()
    named = [key for key, posture in spec.postures.items() if posture.base is not None]
    named += [
        str(state.get("name"))
        for state in states
        if any(len((joint.get("value") or "").split()) == 7 for joint in state.iter("joint"))
    ]
    if not named:
        return ()
    which = default if default in named else ", ".join(dict.fromkeys(named))
    return (
        f"the root is fixed: the base pose of posture {which} is left out, and the root link sits at the world's "
        "origin along its axes; `root='free-flyer'` keeps it",
    )


def _check_base(base: Sequence[float], where: str) -> None:
    norm = float(np.linalg.norm(base[3:]))
    if not (np.isfinite(base).all() and abs(norm - 1) < 1e-3):
        raise SpecError(f"base quaternion of norm {norm:.4g}", where=where, hint="give a unit quaternion x y z w")


def _neutral(model: pin.Model) -> Vector:
    """The neutral configuration, moved to the nearest limits where zero lies outside them."""
    q = np.array(pin.neutral(model), dtype=float)
    scalar = [i for i in range(1, model.njoints) if model.nqs[i] == 1]
    for i in scalar:
        k = model.idx_qs[i]
        q[k] = np.clip(q[k], model.lowerPositionLimit[k], model.upperPositionLimit[k])
    return q


def _remount(model: pin.Model, mounting: Mapping[str, Vector3], name: str) -> None:
    """Move joints with all that hangs on them; the links before them keep their inertias."""
    for joint, offset in mounting.items():
        index = joint_index(model, joint, f"{name} mounting")
        moved = np.array(offset, dtype=float)
        if moved.shape != (3,) or not np.isfinite(moved).all():
            what = "is not finite" if moved.shape == (3,) else "has not three numbers"
            raise InputError(
                f"the offset of '{joint}' {what}", where=f"{name} mounting", hint="give three, in meters"
            )
        placement = model.jointPlacements[index].copy()
        placement.translation = placement.translation + moved
        model.jointPlacements[index] = placement


def _override_limits(model: pin.Model, spec: RobotSpec, name: str) -> None:
    where = f"{name} robot.toml [limits]"
    lower, upper = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    for joint, (low, high) in spec.limits.position.items():
        if not low < high:
            raise SpecError(f"position limits of '{joint}' are [{low}, {high}]", where=where, hint="lower < upper")
        index = joint_index(model, joint, where)
        if model.nqs[index] != 1:
            raise SpecError(f"joint '{joint}' has no position limits", where=where, hint="remove it: it turns freely")
        lower[model.idx_qs[index]], upper[model.idx_qs[index]] = low, high
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
    for values, kind in ((spec.limits.velocity, "Velocity"), (spec.limits.effort, "Effort")):
        low, high = getattr(model, f"lower{kind}Limit").copy(), getattr(model, f"upper{kind}Limit").copy()
        for joint, value in values.items():
            k = model.idx_vs[joint_index(model, joint, where)]
            low[k], high[k] = -value, value
        setattr(model, f"lower{kind}Limit", low)
        setattr(model, f"upper{kind}Limit", high)


def _named(model: pin.Model, patterns: Sequence[str], where: str) -> tuple[str, ...]:
    """Joints by name or pattern, each once.

    Raises:
        JointNotFound: What names no joint, with the nearest names.
    """
    known = [str(n) for n in model.names if n not in ("universe", "root_joint")]
    found: dict[str, None] = {}
    for pattern in patterns:
        fitting = [pattern] if pattern in known else [n for n in known if fnmatchcase(n, pattern)]
        if not fitting:
            raise JointNotFound(
                pattern, known, where=where, hint="(nothing fits this pattern)" if set(pattern) & set("*?[") else ""
            )
        found.update(dict.fromkeys(fitting))
    return tuple(found)


def _lock(
    model: pin.Model, locked: Sequence[str], postures: dict[str, Vector], default: str, name: str
) -> tuple[pin.Model, dict[str, Vector]]:
    ids = [joint_index(model, joint, f"{name} lock") for joint in locked]
    armature = np.array(model.armature)
    reduced = pin.buildReducedModel(model, ids, postures[default])
    kept_q: list[int] = []
    kept_v: list[int] = []
    for i in range(1, model.njoints):
        if i not in ids:
            kept_q += range(model.idx_qs[i], model.idx_qs[i] + model.nqs[i])
            kept_v += range(model.idx_vs[i], model.idx_vs[i] + model.nvs[i])
    if not kept_v:
        raise InputError("every joint is locked", where=f"{name} lock", hint="leave some free")
    reduced.armature = armature[kept_v]
    return reduced, {key: q[kept_q] for key, q in postures.items()}


def describe_sources() -> tuple[str, str]:
    """Where the known robots' data lie: our own folder and example-robot-data's."""
    return str(robots_data()), str(example_robot_data())
