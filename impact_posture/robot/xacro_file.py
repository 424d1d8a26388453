"""Expand xacro files into URDFs.

Expanding a file evaluates the Python expressions in it, so expand only files that you trust.
"""

from __future__ import annotations

import hashlib
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from urllib.parse import quote

from impact_posture.errors import InputError, PackageNotFound, UrdfError, nearest
from impact_posture.system.isolated_calls import CallFailed, isolated_call
from impact_posture.system.libraries import cache_folder
from impact_posture.system.optional_package import import_extra
from impact_posture.system.output_folder import write_whole

# Module of ROS from which xacro gets the folder of a package.
_INDEX = "ament_index_python.packages"
# Limit of the processor time to expand a file, s, because expressions in a file can take hours.
_SECONDS = 10.0


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


class _Packages:
    """Folders of packages: from ``known``, in one of ``folders``, in a folder above ``path``, or from ROS."""

    def __init__(self, path: Path, folders: Sequence[Path], known: Mapping[str, str]) -> None:
        self._path, self._places, self._known = path, [*folders, *path.absolute().parents], known
        self._ros: ModuleType | None = None
        with suppress(ImportError):
            self._ros = import_module(_INDEX)

    def find(self, package: str) -> str:
        """Return the folder of a package; raise ``PackageNotFound`` for an unknown package."""
        if package in self._known:
            return self._known[package]
        for place in self._places:
            if (place / package).is_dir():
                return str(place / package)
        with suppress(LookupError):  # ROS raises this error for an unknown package.
            if self._ros is not None:
                return str(self._ros.get_package_share_directory(package))
        near = sorted(entry.name for place in self._places[:3] for entry in place.glob("[!.]*/"))
        hint = "give the folder that contains this package as `package_dir`"
        raise PackageNotFound(package, near, where=str(self._path), hint=hint)

    @contextmanager
    def indexed(self) -> Iterator[None]:
        """Answer in place of ROS when xacro asks for the folder of a package."""
        index, names = ModuleType(_INDEX), (_INDEX.partition(".")[0], _INDEX)
        index.get_package_share_directory = self.find  # type: ignore[attr-defined]
        before = {name: sys.modules.get(name) for name in names}
        sys.modules.update(dict.fromkeys(names, index))
        try:
            yield
        finally:
            for name, module in before.items():
                if module is None:
                    del sys.modules[name]
                else:
                    sys.modules[name] = module


def expand_xacro(
    path: Path, arguments: Mapping[str, str], folders: Sequence[Path], packages: Mapping[str, str]
) -> Path:
    """Expand a xacro file, and return the path of the URDF in the cache.

    ``arguments`` replace the defaults of ``<xacro:arg>``.  For a package in ``$(find PACKAGE)`` or in a
    ``package://`` path, the function searches ``packages``, then ``folders``, then the folders above the file, then
    ROS.  Relative paths of meshes start from the folder of the xacro file, or from its parent folder, where expanded
    files often are.

    Raises:
        UrdfError: The file cannot be expanded, or this takes too much time or memory.
        PackageNotFound: A package does not exist.
        InputError: xacro is not installed, or the file has no argument of this name.
    """
    values, index = _Arguments(arguments), _Packages(path, folders, packages)
    try:
        text, values.known = isolated_call(lambda: _expanded(path, values, index), _SECONDS)
    except CallFailed as fault:
        raise UrdfError(fault.what, where=str(path), hint="correct it and the files that it includes") from None
    root = ET.fromstring(text)
    unknown = next((name for name in arguments if name not in values.known), None)
    if unknown is not None:
        close = nearest(unknown, values.known, 1)
        hint = f"did you mean {close[0]}?" if close else "it has no arguments"
        raise InputError(f"no argument '{unknown}'", where=str(path), hint=hint)
    if root.find("link") is None:
        hint = "name the file that uses its macros"
        raise UrdfError("expands to a robot without links", where=str(path), hint=hint)
    for mesh in root.iter("mesh"):
        mesh.set("filename", _absolute(mesh.get("filename", ""), path.absolute().parents[:2], index))
    content = ET.tostring(root)
    name = path.name.removesuffix(".xacro").removesuffix(".urdf") + ".urdf"
    urdf = cache_folder("xacro", hashlib.sha256(content).hexdigest()[:16]) / name
    if not urdf.is_file():
        write_whole(urdf, content)
    return urdf


def _expanded(path: Path, values: _Arguments, packages: _Packages) -> tuple[str, set[str]]:
    """Return the text of the URDF, and the names of all arguments that the xacro file has."""
    xacro = import_extra("xacro", "robots")
    try:
        with packages.indexed():
            return xacro.process_file(str(path), mappings=values).toxml(), values.known
    except Exception as error:  # Python expressions in the file may raise any error.
        cause = error
        while isinstance(cause, xacro.XacroException) and isinstance(cause.exc, Exception):
            cause = cause.exc
        if isinstance(cause, InputError | MemoryError):
            raise cause from None
        if isinstance(cause, OSError):
            raise UrdfError.unreadable(Path(cause.filename or path), cause) from None
        fault = f"cannot be expanded ({str(error) or type(cause).__name__})"
        raise UrdfError(fault, where=str(path), hint="correct it, or give its arguments by `xacro_arg`") from None


def _absolute(text: str, folders: Sequence[Path], packages: _Packages) -> str:
    """Return the path of a mesh as a ``file://`` URI; keep ``package://`` paths of packages that do not exist."""
    scheme, colon, rest = text.partition("://")
    if not colon:
        paths = [folder / text for folder in folders]
        return f"file://{quote(str(next((path for path in paths if path.is_file()), paths[0])))}"
    package, _, inside = rest.partition("/")
    with suppress(PackageNotFound):
        if scheme == "package":
            return f"file://{quote(str(Path(packages.find(package), inside)))}"
    return text
