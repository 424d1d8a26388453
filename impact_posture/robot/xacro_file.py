"""Expand xacro files into URDFs.

Expanding a file evaluates the Python expressions in it, so expand only files that you trust.
"""

from __future__ import annotations

import hashlib
import io
import os
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from unittest.mock import patch
from urllib.parse import quote

from impact_posture.errors import InputError, PackageNotFound, UrdfError, nearest
from impact_posture.system.libraries import cache_folder
from impact_posture.system.optional_package import import_extra


class _Arguments(dict[str, str]):
    """Arguments of a xacro file that remember which of them were read."""

    def __init__(self, values: Mapping[str, str]) -> None:
        super().__init__(values)
        self.known: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.known.add(str(name))
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.known.add(name)
        return super().__getitem__(name)


def expand_xacro(
    path: Path, arguments: Mapping[str, str], folders: Sequence[Path], packages: Mapping[str, str] | None = None
) -> Path:
    """Expand a xacro file, and return the path of the URDF in the cache.

    ``arguments`` replace the defaults of ``<xacro:arg>``.  A package in ``$(find PACKAGE)`` and in ``package://``
    paths is in ``packages``, or has this name in one of the ``folders`` or in a folder above the file, or is a
    package of ROS.  Relative paths of meshes start from the folder of the xacro file, or from
    the folder above it, where expanded files often are.

    Raises:
        UrdfError: The file cannot be expanded.
        PackageNotFound: A package does not exist.
        InputError: xacro is not installed, or the file has no argument of this name.
    """
    xacro = import_extra("xacro", "robots")
    places = [*folders, *path.absolute().parents]
    ros: ModuleType | None = None
    with suppress(ImportError):
        ros = import_module("ament_index_python.packages")

    def find(package: str) -> str:
        if package in (packages or {}):
            return str((packages or {})[package])
        for place in places:
            if (place / package).is_dir():
                return str(place / package)
        with suppress(LookupError):  # ROS raises this error for an unknown package.
            if ros is not None:
                return str(ros.get_package_share_directory(package))
        siblings = sorted(entry.name for place in places[:3] if place.is_dir() for entry in place.iterdir())
        hint = "name the folder above it with `package_dir`"
        raise PackageNotFound(package, siblings, where=str(path), hint=hint)

    values = _Arguments(arguments)
    try:
        # xacro asks this module of ROS for packages, and prints the place of an error.
        with patch.dict(sys.modules, _index(find)), redirect_stderr(io.StringIO()):
            text = xacro.process_file(str(path), mappings=values).toxml()
        root = ET.fromstring(text)
    except InputError:
        raise
    except OSError as error:
        raise UrdfError.unreadable(path, error) from None
    except Exception as error:  # Expressions raise any error, and xacro wraps the errors of this function.
        inner = error
        while isinstance(inner, xacro.XacroException) and isinstance(inner.exc, Exception):
            inner = inner.exc
        if isinstance(inner, InputError):
            raise inner from None
        fault = f"cannot be expanded ({error or type(error).__name__})"
        raise UrdfError(fault, where=str(path), hint="correct it, or give its arguments by `xacro_arg`") from None
    unknown = next((name for name in arguments if name not in values.known), None)
    if unknown is not None:
        close = nearest(unknown, values.known, 1)
        hint = f"did you mean {close[0]}?" if close else "it has no arguments"
        raise InputError(f"no argument '{unknown}'", where=str(path), hint=hint)
    if root.find("link") is None:
        hint = "name the file that uses its macros"
        raise UrdfError("expands to a robot without links", where=str(path), hint=hint)
    for mesh in root.iter("mesh"):
        mesh.set("filename", _absolute(mesh.get("filename", ""), path.absolute().parents[:2], find))
    content = ET.tostring(root)
    name = path.name.removesuffix(".xacro").removesuffix(".urdf") + ".urdf"
    urdf = cache_folder("xacro", hashlib.sha256(content).hexdigest()[:16]) / name
    if not urdf.is_file():
        beside = urdf.with_name(f"{name}-{os.getpid()}")
        beside.write_bytes(content)
        os.replace(beside, urdf)
    return urdf


def _index(find: Callable[[str], str]) -> dict[str, ModuleType]:
    """Return the modules of ROS from which xacro gets the folder of a package."""
    parent, packages = ModuleType("ament_index_python"), ModuleType("ament_index_python.packages")
    packages.get_package_share_directory = find  # type: ignore[attr-defined]
    return {module.__name__: module for module in (parent, packages)}


def _absolute(text: str, folders: Sequence[Path], find: Callable[[str], str]) -> str:
    """Return the path of a mesh as a ``file://`` URI; keep ``package://`` paths of packages that do not exist."""
    scheme, colon, rest = text.partition("://")
    if not colon:
        paths = [folder / text for folder in folders]
        return f"file://{quote(str(next((path for path in paths if path.is_file()), paths[0])))}"
    package, _, inside = rest.partition("/")
    with suppress(PackageNotFound):
        if scheme == "package":
            return f"file://{quote(str(Path(find(package), inside)))}"
    return text
