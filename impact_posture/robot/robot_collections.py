"""Robots in the collections of other packages: MuJoCo Menagerie, and robot_descriptions.

Both packages download the files of a robot when it is first used, and keep these files in their caches.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from impact_posture.errors import InputError, RobotNotFound
from impact_posture.robot.urdf import EXAMPLE_PREFIX, example_models
from impact_posture.system.optional_package import import_extra
from impact_posture.system.progress import tell

_MENAGERIE, _DESCRIPTIONS = "menagerie:", "robot_descriptions:"
COLLECTIONS = (EXAMPLE_PREFIX, _MENAGERIE, _DESCRIPTIONS)
"""Prefixes of the names of robots in collections."""

_EXTRA = "robots"


class CollectedRobot(NamedTuple):
    """Files of a robot in a collection.

    Attributes:
        path: URDF, xacro file or MJCF.
        folders: Folders in which ``package://`` paths are searched.
        srdf: SRDF; ``None`` if the collection has none.
        packages: Name of a package that the xacro file uses → its folder.
        arguments: Arguments of the xacro file.
    """

    path: Path
    folders: tuple[Path, ...] = ()
    srdf: str | None = None
    packages: Mapping[str, str] = {}
    arguments: Mapping[str, str] = {}


def ways_to_name() -> tuple[str, ...]:
    """Return the forms of the argument ROBOT, one line each."""
    menagerie, descriptions = (
        "installed" if find_spec(package.replace("-", "_")) else f"not installed: pip install {package}"
        for package in ("mujoco-menagerie", "robot_descriptions")
    )
    return (
        "a known name, as listed",
        "a path to a URDF, a xacro file (with --xacro-arg NAME:=VALUE) or an MJCF (.xml); a robot.toml beside it, or "
        "--config, adds data that the file lacks",
        f"{EXAMPLE_PREFIX}<path below its robots/ folder>",
        f"{_MENAGERIE}<robot>, or <robot>/<model>, such as {_MENAGERIE}unitree_g1; the first use downloads its MJCF, "
        f"0.1 to 24 MB ({menagerie})",
        f"{_DESCRIPTIONS}<module>, such as {_DESCRIPTIONS}panda_description or {_DESCRIPTIONS}panda_mj_description; "
        f"the first use clones the git repository of the robot ({descriptions})",
    )


def names_with(text: str) -> list[str]:
    """Return the names in the installed collections that contain ``text``."""
    names = [EXAMPLE_PREFIX + path for path in example_models() if text.casefold() in Path(path).stem.casefold()]
    with suppress(ImportError):
        names += [_MENAGERIE + name for name in import_module("mujoco_menagerie").names() if text in name]
    with suppress(ImportError):
        names += [_DESCRIPTIONS + name for name in import_module("robot_descriptions").DESCRIPTIONS if text in name]
    return names


def collected(robot: str) -> CollectedRobot:
    """Return the files of a robot whose name begins with ``menagerie:`` or ``robot_descriptions:``.

    Raises:
        RobotNotFound: The collection lacks this robot.
        InputError: The package is not installed, or cannot download the robot.
    """
    collection, _, name = robot.partition(":")
    return _from_menagerie(name) if f"{collection}:" == _MENAGERIE else _from_descriptions(name)


def _from_menagerie(name: str) -> CollectedRobot:
    menagerie = import_extra("mujoco_menagerie", _EXTRA, "mujoco-menagerie")
    folder, _, model = name.partition("/")
    if folder not in menagerie.names():
        raise RobotNotFound(folder, menagerie.names(), where=_MENAGERIE.rstrip(":"))
    robot = menagerie.get(folder)
    if model and model not in robot.entry_names:
        raise RobotNotFound(model, robot.entry_names, where=_MENAGERIE + folder)
    cache = menagerie.Cache()
    if not cache.root and not cache.is_cached(robot):
        tell(f"downloading {folder} ({(robot.download_size or 0) / 1e6:.1f} MB) into {cache.dir}")
    try:
        return CollectedRobot(robot.path(cache, None) / robot.entry(model or robot.default_model).file)
    except (menagerie.MenagerieError, OSError) as error:
        hint = "check the network, or set MENAGERIE_ROOT to a clone of mujoco_menagerie"
        raise InputError(f"cannot be downloaded ({error})", where=_MENAGERIE + name, hint=hint) from None


def _from_descriptions(name: str) -> CollectedRobot:
    known = import_extra("robot_descriptions", _EXTRA).DESCRIPTIONS
    if name not in known:
        raise RobotNotFound(name, known, where=_DESCRIPTIONS.rstrip(":"))
    tell(f"reading {name}, whose git repository is cloned on its first use")
    try:
        # Cloning prints a progress bar.
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            module = import_module(f"robot_descriptions.{name}")
    except Exception as error:  # Git raises many types of errors.
        lines = str(error).strip().splitlines() or [type(error).__name__]
        hint = "check the network and that git is installed"
        raise InputError(f"cannot be cloned ({lines[-1].strip()})", where=_DESCRIPTIONS + name, hint=hint) from None
    files = [getattr(module, key, None) for key in ("URDF_PATH", "MJCF_PATH", "XACRO_PATH")]
    path = next((file for file in files if file), None)
    if path is None:
        raise InputError("has no URDF, MJCF or xacro file", where=_DESCRIPTIONS + name, hint="name another robot")
    homes = [Path(module.PACKAGE_PATH), Path(module.REPOSITORY_PATH)]
    return CollectedRobot(
        Path(path),
        tuple(folder for home in homes for folder in (home, home.parent)),
        getattr(module, "SRDF_PATH", None),
        getattr(module, "XACRO_PACKAGE_PATHS", {}),
        getattr(module, "XACRO_ARGS", {}),
    )
