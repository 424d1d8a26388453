"""Reading of a URDF into a ``pin.Model`` without its meshes, with plain errors."""

from __future__ import annotations

import contextlib
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import IO

import pinocchio as pin

from impact_posture.errors import PackageNotFound, SpecError, UrdfError, nearest
from impact_posture.robot.inertia_checks import check_inertias

# The data of Pinocchio always hold 6 nv³ numbers: 0.4 GB at 200 degrees of freedom and 48 GB at 1,000.
MOST_DEGREES_OF_FREEDOM = 200
# Joints from the root to a tip, fixed ones included; the URDF parser overflows the stack somewhere above 2,000.
_DEEPEST = 1_000

EXAMPLE_PREFIX = "example-robot-data:"


@cache
def example_robot_data() -> Path:
    """Return the ``robots/`` folder of the installed example-robot-data package.

    Raises:
        PackageNotFound: The package is not installed, or its files are elsewhere.
    """
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import files as dist_files

    try:
        listed = dist_files("example-robot-data") or []
    except PackageNotFoundError:
        listed = []
    for entry in listed:
        parts = entry.parts
        if "example-robot-data" in parts and "robots" in parts:
            return Path(str(entry.locate())).parents[len(parts) - parts.index("robots") - 2]
    raise PackageNotFound("example-robot-data", [], hint="pip install example-robot-data")


def robots_data() -> Path:
    """Return the folder of the robot descriptions that ship with this project."""
    return Path(str(files("impact_posture_robots")))


def resolve_path(text: str, base: Path) -> Path:
    """Return the file of a path in robot.toml.

    The path is ``example-robot-data:<below robots/>``, absolute, or relative to ``base``.

    Raises:
        PackageNotFound: There is no such file in the package; carries the nearest paths below ``robots/``.
        SpecError: No path of any system has such characters.
    """
    if "\0" in text:
        raise SpecError(f"'{text}' is no path", where="robot.toml [model]", hint="remove the null character")
    if not text.startswith(EXAMPLE_PREFIX):
        return (base / Path(text).expanduser()).resolve()
    root = example_robot_data()
    path = root / text.removeprefix(EXAMPLE_PREFIX)
    if not os.path.isfile(path):
        known = example_models(path.suffix)
        raise PackageNotFound(text.removeprefix(EXAMPLE_PREFIX), known, where=EXAMPLE_PREFIX.rstrip(":"))
    return path


def example_models(suffix: str = ".urdf") -> list[str]:
    """Return the paths of models below the ``robots/`` folder of example-robot-data, sorted."""
    root = example_robot_data()
    return [p.relative_to(root).as_posix() for p in sorted(root.rglob("*.[us]rdf")) if str(p).endswith(suffix)]


def build_model(
    path: Path, *, free_flyer: bool, accept_inertias: bool = False
) -> tuple[pin.Model, tuple[str, ...], dict[str, str]]:
    """Parse the URDF at ``path`` without opening meshes; return the model, warnings and which joint mimics which.

    Args:
        path: The URDF.
        free_flyer: Put a free-flyer joint between the world and the root link.
        accept_inertias: Turn refusals of impossible inertias into warnings.

    Raises:
        UrdfError: The file is missing or is no URDF, Pinocchio rejects its tree, or it has too many joints.
        InertiaError: A link has a mass or inertia that no rigid body has.
    """
    root = parse_urdf(path)
    _check_depth(root, path)
    try:
        with quiet_stderr() as words:
            model = pin.buildModelFromUrdf(str(path), *([pin.JointModelFreeFlyer()] if free_flyer else []))
    except Exception as error:  # Pinocchio raises ValueError, RuntimeError or IndexError, by version and fault.
        said = words[0] or str(error)
        raise UrdfError(f"makes no robot ({said})", where=str(path), hint="correct the URDF") from None
    if model.nv == 0:
        raise UrdfError("has no movable joint", where=str(path), hint="use `root='free-flyer'` or another URDF")
    first = 2 if free_flyer else 1
    if model.njoints > first and model.joints[first].shortname() == "JointModelFreeFlyer":
        raise UrdfError(
            f"its first joint, '{model.names[first]}', is floating",
            where=str(path),
            hint="remove that joint with its parent link, and use `root='free-flyer'`",
        )
    if model.nv > MOST_DEGREES_OF_FREEDOM:
        raise UrdfError(
            f"has {model.nv} degrees of freedom, more than the supported {MOST_DEGREES_OF_FREEDOM}",
            where=str(path),
            hint="fix joints in the URDF that hardly matter",
        )
    mimics, lost = _mimics(root)
    return model, (*check_inertias(root, model, path, accept_inertias), *lost), mimics


def _check_depth(root: ET.Element, path: Path) -> None:
    """Refuse trees that end the process: the URDF parser descends them without a bound, and follows circles."""
    joints = [(joint.find("parent"), joint.find("child")) for joint in root.findall("joint")]
    above = {c.get("link"): p.get("link") for p, c in joints if p is not None and c is not None}
    depth: dict[str | None, int] = {}
    for link in above:
        way, seen = [], set[str | None]()
        at: str | None = link
        while at in above and at not in depth:
            if at in seen:
                raise UrdfError(f"link '{at}' is below itself", where=str(path), hint="correct its joints")
            seen.add(at)
            way.append(at)
            at = above[at]
        for at in reversed(way):
            depth[at] = depth.get(above[at], 0) + 1
        if depth[link] > _DEEPEST:
            hint = "fix joints in the URDF that hardly matter"
            raise UrdfError(f"has a chain of more than {_DEEPEST} joints", where=str(path), hint=hint)


def _mimics(root: ET.Element) -> tuple[dict[str, str], list[str]]:
    """Return the joints that mimic another, with it, and a warning for each that mimics what is no joint."""
    joints = {joint.get("name", ""): joint.find("mimic") for joint in root.findall("joint")}
    followed = {name: mimic.get("joint", "") for name, mimic in joints.items() if mimic is not None}
    lost = [
        f"joint '{name}' mimics '{other}', which is no joint of the URDF (did you mean "
        f"{nearest(other, joints, 1)[0]}?): it moves by itself; correct its <mimic>"
        for name, other in followed.items()
        if other not in joints
    ]
    return {name: other for name, other in followed.items() if other in joints}, lost


def parse_urdf(path: Path) -> ET.Element:
    """Return the root of the URDF at ``path``.

    Raises:
        UrdfError: The file is missing or is no URDF.
    """
    if os.path.isdir(path):
        raise UrdfError("is a folder", where=str(path), hint="name the .urdf file in it")
    try:
        root = ET.parse(path).getroot()
    except FileNotFoundError:
        raise UrdfError("no such file", where=str(path), hint="check the path") from None
    except OSError as error:
        raise UrdfError(f"cannot be read ({error.strerror})", where=str(path), hint="check the file") from None
    except (ET.ParseError, ValueError) as error:  # A ValueError, if no file can have such a name.
        raise UrdfError(f"is not XML ({error})", where=str(path), hint="give a URDF file") from None
    if root.tag != "robot":
        raise UrdfError(
            f"is XML but not a URDF: its root is <{root.tag}>, not <robot>",
            where=str(path),
            hint="expand xacro first, or give the .urdf",
        )
    if root.find("link") is None:
        raise UrdfError("has no <link>", where=str(path), hint="expand xacro first, or give the .urdf")
    return root


def _nameless_file() -> IO[bytes]:
    """Return a file in memory if the system supports it, because no folder may be writable."""
    return os.fdopen(os.memfd_create("words"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile()


@contextlib.contextmanager
def quiet_stderr() -> Iterator[list[str]]:
    """Keep the output of the URDF parser off the terminal, and yield its first error line in a list."""
    words = [""]
    with _nameless_file() as sink:
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)
        try:
            yield words
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            lines = sink.read().decode(errors="replace").split("\n")
            words[0] = next((line.strip() for line in lines if "rror" in line), "")
