"""Read a URDF into a ``pin.Model``, meshes or not, and say plainly what is wrong with one that cannot be."""

from __future__ import annotations

import contextlib
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import IO

import pinocchio as pin

from impact_posture.errors import JointNotFound, PackageNotFound, UrdfError
from impact_posture.robot.inertia_checks import check_inertias

# Pinocchio's data hold 6 nv³ numbers, 0.4 GB at 200 degrees of freedom and 48 GB at 1,000, whatever is asked of it.
MOST_DEGREES_OF_FREEDOM = 200

EXAMPLE_PREFIX = "example-robot-data:"


def example_robot_data() -> Path:
    """Return the ``robots/`` folder of the installed example-robot-data package.

    Raises:
        PackageNotFound: The package is not installed or is laid out otherwise.
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
            root = Path(*parts[: parts.index("robots") + 1])
            located = Path(str(entry.locate()))
            return located.parents[len(parts) - len(root.parts) - 1]
    raise PackageNotFound("example-robot-data", [], hint="pip install example-robot-data")


def robots_data() -> Path:
    """Return the folder with this project's own robot descriptions."""
    return Path(str(files("impact_posture_robots")))


def resolve_path(text: str, base: Path) -> Path:
    """Turn a path of robot.toml into a file.

    It is ``example-robot-data:<below robots/>``, absolute, or relative to ``base``.

    Raises:
        PackageNotFound: With the nearest paths below ``robots/``.
    """
    if not text.startswith(EXAMPLE_PREFIX):
        return (base / Path(text).expanduser()).resolve()
    root = example_robot_data()
    path = root / text.removeprefix(EXAMPLE_PREFIX)
    if not path.is_file():
        fitting = example_models(path.suffix)
        raise PackageNotFound(text.removeprefix(EXAMPLE_PREFIX), fitting, where=EXAMPLE_PREFIX.rstrip(":"))
    return path


def example_models(suffix: str = ".urdf") -> list[str]:
    """Paths below the ``robots/`` folder of example-robot-data, sorted."""
    root = example_robot_data()
    return [p.relative_to(root).as_posix() for p in sorted(root.rglob("*.[us]rdf")) if str(p).endswith(suffix)]


def build_model(path: Path, *, free_flyer: bool, accept_inertias: bool = False) -> tuple[pin.Model, tuple[str, ...]]:
    """Parse the URDF at ``path``; no mesh is opened.  Returns the model and warnings about its links.

    Args:
        path: The URDF.
        free_flyer: Put a free-flyer joint between the world and the root link.
        accept_inertias: Turn refusals of impossible inertias into warnings.

    Raises:
        UrdfError: Missing file, not XML, not a URDF, a tree that Pinocchio rejects, or too many joints.
        InertiaError: A mass or inertia that no rigid body has.
    """
    root = _parse(path)
    try:
        with _quiet_stderr() as words:
            if free_flyer:
                model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
            else:
                model = pin.buildModelFromUrdf(str(path))
    except Exception as error:  # Pinocchio raises ValueError, RuntimeError or IndexError by version and fault.
        said = words[0] or str(error)
        raise UrdfError(f"makes no robot ({said})", where=str(path), hint="correct the URDF") from None
    if model.nv == 0:
        raise UrdfError("has no movable joint", where=str(path), hint="use `root='free-flyer'` or another URDF")
    if model.nv > MOST_DEGREES_OF_FREEDOM:
        raise UrdfError(
            f"has {model.nv} degrees of freedom, more than the {MOST_DEGREES_OF_FREEDOM} that are computed with",
            where=str(path),
            hint="make joints that hardly matter fixed in the URDF",
        )
    return model, check_inertias(root, model, path, accept_inertias)


def joint_index(model: pin.Model, joint: str, where: str) -> int:
    """Index of a movable joint by name.

    Raises:
        JointNotFound: With the nearest names.
    """
    known = [n for n in model.names if n not in ("universe", "root_joint")]
    if joint not in known:
        raise JointNotFound(joint, known, where=where)
    return int(model.getJointId(joint))


def _parse(path: Path) -> ET.Element:
    if path.is_dir():
        raise UrdfError("is a folder", where=str(path), hint="name the .urdf file in it")
    try:
        root = ET.parse(path).getroot()
    except FileNotFoundError:
        raise UrdfError("no such file", where=str(path), hint="check the path") from None
    except OSError as error:
        raise UrdfError(f"cannot be read ({error.strerror})", where=str(path), hint="check the file") from None
    except (ET.ParseError, UnicodeDecodeError) as error:
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
    """A file in memory where the system has such: to read a robot, no folder need be writable."""
    return os.fdopen(os.memfd_create("words"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile()


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[list[str]]:
    """Keep the URDF parser's own words off the terminal; hand back the first line of them."""
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
