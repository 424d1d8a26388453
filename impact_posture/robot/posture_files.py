"""Read postures: by name, or from ``posture.json``, joints by name, or a ``sensor_msgs/JointState``."""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from impact_posture.errors import JointLocked, JointNotFound, PostureError, PostureNotFound, nearest, shown
from impact_posture.robot.joint_coupling import coupled
from impact_posture.robot.model_joints import q_slice, scalar_entries, scalar_value
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.text_files import read_text

SCHEMA = "impact-posture/posture/1"

_KEYS = ("schema", "robot", "convention", "joint_names", "q", "q_names", "base", "joints")
# Largest difference between ``q`` and the joints by name in one file, rad or m.
_SAME = 1e-6
_SHAPES = "q with joint_names, joints by name, or a JointState's name and position"

_FIXED = ", but the root is fixed, with the root link at the world's origin along its axes"
_NO_BASE = "remove the base and give `normal` in those axes, or use `root` free-flyer"


def read_posture(robot: Robot, text: str | Array | Sequence[float] | None, where: str = "posture") -> Array:
    """Return the posture that ``text`` names, shape (nq,); check its length, quaternion and limits.

    Args:
        robot: The robot.
        text: Name of a posture of the robot, or a file: ``posture.json`` (``q`` in the order of ``joint_names``),
            ``{"base": [x, y, z, qx, qy, qz, qw], "joints": {name: value}}``, or a ``sensor_msgs/JointState`` in YAML
            (``name: [...]``, ``position: [...]``).  The value of a continuous joint is an angle, rad.  Joints that
            the file does not name stay as in the default posture.  ``None`` means the default posture.  If ``text``
            is a configuration, shape (nq,), the function only checks it.
        where: Option or file, for error messages.

    Raises:
        PostureNotFound: ``text`` is neither a posture nor a file.
        JointNotFound: The file names a joint that the robot does not have.
        PostureError: The file cannot be read, or is not a posture of this robot.
    """
    if not (text is None or isinstance(text, str)):
        return robot.check_posture(np.asarray(text, dtype=float), where=where)
    if text is None or text in robot.postures:
        return robot.check_posture(robot.posture(text), where=f"{where} {text or robot.default_posture}")
    path = posture_path(text)
    if path is None:
        raise PostureNotFound(text, robot.postures, where=where, hint="(or give a .json or .yaml file)")
    data = _load(path)
    return robot.check_posture(_configuration(robot, data, str(path)), where=str(path))


def write_posture(robot: Robot, q: Array) -> dict[str, object]:
    """Return the content of ``posture.json`` for ``q``, shape (nq,); raise ``PostureError`` if ``q`` is not valid."""
    q = robot.check_posture(q, limits=False)
    return {
        "schema": SCHEMA,
        "robot": robot.name,
        "convention": robot.convention,
        "joint_names": list(robot.joint_names),
        "q": q.tolist(),
        "q_names": list(robot.q_names),
        **_named_values(robot, q),
    }


def _named_values(robot: Robot, q: Array) -> dict[str, object]:
    """Return ``q`` as ``base`` and ``joints`` by name, as :func:`set_joints` reads them."""
    model, values = robot.model, dict[str, object]()
    for name in robot.joint_names:
        index = robot.joint_id(name)
        values[name] = scalar_value(model, index, q) if model.nvs[index] == 1 else q[q_slice(model, index)].tolist()
    return {**({"base": q[:7].tolist()} if robot.floating else {}), "joints": values}


def posture_path(text: str) -> Path | None:
    """Return the path of a posture file, or ``None`` if ``text`` cannot be one."""
    path = Path(text).expanduser()
    return path if path.suffix in (".json", ".yaml", ".yml") or os.path.isfile(path) else None


def _load(path: Path) -> Mapping[str, object]:
    import yaml  # Imported here, because few postures come from files.

    kind = "JSON" if path.suffix == ".json" else "YAML"
    try:
        text = read_text(path)
        # `ros2 topic echo` ends each message with `---`, so only the first document is read.  BaseLoader keeps
        # scalars as text.  Other loaders read 1:30 as 90 and a joint name `on` as true, and fail on unknown tags.
        data = json.loads(text) if kind == "JSON" else next(yaml.load_all(text, yaml.BaseLoader), None)
    except OSError as error:
        raise PostureError.unreadable(path, error) from None
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise PostureError(f"is not valid {kind} ({error})", where=str(path), hint="correct the syntax") from None
    if not isinstance(data, dict):
        raise PostureError("holds no posture", where=str(path), hint=f"give {_SHAPES}")
    return {str(key): value for key, value in data.items()}


def _configuration(robot: Robot, data: Mapping[str, object], where: str) -> Array:
    """Return the configuration in a posture file.  The keys of ``data`` show which of three formats the file has."""
    schema = data.get("schema", SCHEMA)
    if schema != SCHEMA:
        fault = f"schema '{shown(schema)}' is not a posture"
        raise PostureError(fault, where=where, hint=f'give a file of "{SCHEMA}"')
    if "q" in data:
        _only(data, where)
        q = _in_order(robot, data, where)
        if len(q) == robot.nq and ("joints" in data or "base" in data):
            _check_same(robot, q, _by_name(robot, q, data, where), where)
        return q
    if "joints" in data or "base" in data:
        _only(data, where)
        return _by_name(robot, robot.posture(), data, where)
    if "name" in data and "position" in data:
        names, values = _names(data["name"], "name", where), _numbers(data["position"], "position", where)
        if len(names) != len(values):
            fault = f"{len(names)} names but {len(values)} positions"
            raise PostureError(fault, where=where, hint="give one position per name")
        return set_joints(robot, robot.posture(), dict(zip(names, values, strict=True)), where)
    raise PostureError("holds no posture", where=where, hint=f"give {_SHAPES}")


def _only(data: Mapping[str, object], where: str) -> None:
    for key in data:
        if key not in _KEYS:
            close = ", ".join(nearest(key, _KEYS))
            raise PostureError(f"unknown key '{shown(key)}'", where=where, hint=f"did you mean {close}?")


def _in_order(robot: Robot, data: Mapping[str, object], where: str) -> Array:
    if "joint_names" in data:
        names = _names(data["joint_names"], "joint_names", where)
        for name in names:
            if name in robot.locked:
                raise JointLocked(name, where=where)
            if name not in robot.joint_names:
                raise JointNotFound(name, robot.joint_names, where=where)
        if tuple(names) != robot.joint_names:
            missing = [name for name in robot.joint_names if name not in names]
            fault = f"leaves out joint '{missing[0]}'" if missing else "has the joints in another order"
            fault = f"{fault}, so that q cannot be read"
            raise PostureError(fault, where=where, hint='give the joints by name: "joints": {"name": value}')
    if data.get("q_names", list(robot.q_names)) != list(robot.q_names):
        fault = "has q_names that do not fit the robot, so q cannot be read"
        raise PostureError(fault, where=where, hint='give the joints by name: "joints": {"name": value}')
    q = _numbers(data["q"], "q", where)
    if not robot.floating and len(q) == robot.nq + 7:
        raise PostureError("begins with a base pose" + _FIXED, where=where, hint=_NO_BASE)
    return np.array(q)


def _by_name(robot: Robot, q: Array, data: Mapping[str, object], where: str) -> Array:
    joints, base, q = data.get("joints", {}), data.get("base"), q.copy()
    if not isinstance(joints, dict):
        raise PostureError("'joints' is not a table", where=where, hint='write "joints": {"name": value}')
    if base is not None:
        if not robot.floating:
            raise PostureError("gives a base pose" + _FIXED, where=where, hint=_NO_BASE)
        pose = _numbers(base, "base", where)
        if len(pose) != 7:
            raise PostureError(f"'base' has {len(pose)} numbers", where=where, hint="give [x, y, z, qx, qy, qz, qw]")
        q[:7] = pose
    return set_joints(robot, q, {str(name): value for name, value in joints.items()}, where)


def _check_same(robot: Robot, q: Array, named: Array, where: str) -> None:
    """Raise an error if a file gives an entry of ``q`` twice, with different values."""
    for name, one, other in zip(robot.q_names, q, named, strict=True):
        if abs(one - other) > _SAME:
            fault = f"{name} is {one:.6g} in q, but {other:.6g} under its name"
            raise PostureError(fault, where=where, hint="remove either q, or base and joints")


def set_joints(robot: Robot, q: Array, joints: Mapping[str, object], where: str) -> Array:
    """Return a copy of the posture ``q``, shape (nq,), with new values of the named ``joints``.

    A value is a number for a joint of one degree of freedom, and the list of its entries of ``q`` for other joints.
    The result is not checked.  Errors name ``where``, an option or file.

    Raises:
        JointNotFound: The robot does not have a joint.
        PostureError: A value is invalid.
    """
    q = q.copy()
    for name, value in joints.items():
        if name in robot.locked:  # ROS messages name all joints, but a locked joint has no entry in q.
            continue
        if name not in robot.joint_names:
            raise JointNotFound(name, robot.joint_names, where=where)
        index = robot.joint_id(name)
        entries = q_slice(robot.model, index)
        if robot.model.nvs[index] == 1:
            angle = _number(value, f"joint '{name}'", where)
            # A NaN in the cosine and sine of a continuous joint would be reported without the name of the joint.
            if not math.isfinite(angle):
                raise PostureError(f"joint '{name}' is not finite", where=where, hint="correct it")
            q[entries] = scalar_entries(robot.model, index, angle, where)
        else:
            numbers, nq = _numbers(value, f"joint '{name}'", where), int(robot.model.nqs[index])
            if len(numbers) != nq:
                fault = f"joint '{name}' takes {nq} numbers, not {len(numbers)}"
                raise PostureError(fault, where=where, hint="correct it")
            q[entries] = numbers
    return coupled(robot.model, [c for c in robot.couplings if c.follower not in joints], q)


def _names(value: object, key: str, where: str) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise PostureError(f"'{key}' is not a list of names", where=where, hint="correct it")
    twice = next((name for name, count in Counter(value).items() if count > 1), None)
    if twice is not None:
        raise PostureError(f"'{key}' names '{shown(twice)}' twice", where=where, hint="remove one of them")
    return value


def _numbers(value: object, key: str, where: str) -> list[float]:
    if not isinstance(value, list):
        raise PostureError(f"'{key}' is not a list of numbers", where=where, hint="correct it")
    return [_number(item, f"'{key}' entry {k}", where) for k, item in enumerate(value)]


def _number(value: object, key: str, where: str) -> float:
    # Numbers in YAML files are read as text.  Infinity and NaN are .inf and .nan in YAML.
    if isinstance(value, (int, float, str)) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            return float(re.sub(r"\.(?=(inf|nan)$)", "", value, flags=re.I) if isinstance(value, str) else value)
    raise PostureError(f"{key} is '{shown(value)}', not a number", where=where, hint="correct it")
