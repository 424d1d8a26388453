"""Read mesh files of users in a copy of this process, because a damaged file may crash the mesh library."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from impact_posture.collision.shape_corners import Triangles, mesh_points, mesh_triangles, renumbered
from impact_posture.config.cached_values import do_not_store
from impact_posture.system.arrays import Array
from impact_posture.system.isolated_calls import CallFailed, CallTimedOut, isolated_calls
from impact_posture.system.text_files import open_regular, read_bytes

# Largest mesh file, bytes, because loading a binary STL takes about 20 times its size in memory.
LARGEST_FILE = 100_000_000
# Longest processor time for reading a mesh: ``_SECONDS``, plus 1 s for each ``_BYTES_PER_SECOND`` bytes.  Reading the
# largest allowed binary STL takes 16 s.
_SECONDS, _BYTES_PER_SECOND = 5.0, 2_500_000
# Least time limit, s, for reading a mesh if other meshes of the robot took too long.
_LEAST_SECONDS = 0.5
# Largest number of vertices of a mesh, or one vertex per byte of its file if this is more.  The limit is needed
# because a short file can repeat its parts a million times.
_MOST_VERTICES = 200_000
# Largest number of meshes in memory, which is enough for one robot.
_MOST_MESHES = 100
# Number of bytes at the start of a mesh file in which the up axis and the unit are searched.
_HEAD = 10_000
# Pattern of the unit in each mesh format that can state a unit.  The unit is a number of meters, or a name.
_UNIT_TAGS = {
    ".dae": rb"""<unit\b[^>]*?\bmeter\s*=\s*["']([^"']*)""",
    ".x3d": rb"""<unit\b(?=[^>]*\bcategory\s*=\s*["']length["'])[^>]*?\bconversionFactor\s*=\s*["']([^"']*)""",
    ".amf": rb"""<amf\b[^>]*?\bunit\s*=\s*["']([^"']*)""",
    ".3mf": rb"""<model\b[^>]*?\bunit\s*=\s*["']([^"']*)""",
}
# Names of units in AMF and 3MF files → length of the unit, m.
_UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "feet": 0.3048, "foot": 0.3048}

_Stamp = tuple[Path, int, int, int]
# Meshes by path, size, inode and time of change; an exception for a mesh that cannot be read.
_READ: dict[_Stamp, Mesh | Exception] = {}


class UnusableShape(Exception):
    """A shape cannot be used; the message contains the reason and a hint."""


class Mesh(NamedTuple):
    """The content of a mesh file.

    Attributes:
        points: Vertices in the unit of the file, shape (k, 3).
        triangles: Indices of vertices, shape (n, 3); ``None`` if the parts of the file cannot be separated.
        unit: Unit of length that the file states, m; 1 if it states none.
    """

    points: Array
    triangles: Triangles | None
    unit: float


def read_meshes(paths: Iterable[Path]) -> None:
    """Read mesh files in advance for :func:`read_mesh`.  A single process reads all files, which saves time."""
    stamps = [stamp for stamp in dict.fromkeys(map(_stamp, paths)) if stamp not in _READ]
    for stamp in list(_READ)[: max(0, len(_READ) + len(stamps) - _MOST_MESHES)]:
        del _READ[stamp]

    def seconds(stamp: _Stamp) -> float:
        # Each mesh that took too long halves the time limit of the next mesh, so that many meshes do not take
        # minutes.
        slow = sum(isinstance(_READ.get(other), CallTimedOut) for other in stamps)
        return max((_SECONDS + stamp[1] / _BYTES_PER_SECOND) * 0.5**slow, _LEAST_SECONDS)

    _READ.update(zip(stamps, isolated_calls(_parsed, stamps, seconds), strict=True))


def read_mesh(path: Path) -> Mesh:
    """Return the content of a mesh file.

    Raises:
        UnusableShape: The mesh cannot be read, is empty, or reading it crashes or takes too long.
    """
    stamp = _stamp(path)
    if stamp not in _READ:
        read_meshes([path])
    match _READ[stamp]:
        case Mesh() as mesh:
            return mesh
        case CallFailed() as fault:
            do_not_store()
            raise UnusableShape(f"{path} {fault.what}; export it again")
        case UnusableShape() as fault:
            raise UnusableShape(*fault.args)
        case _:
            raise UnusableShape(f"{path} cannot be read as a mesh, or is empty; export it again")


def _stamp(path: Path) -> _Stamp:
    state = path.stat()
    return path, state.st_size, state.st_ino, state.st_mtime_ns


def _parsed(stamp: _Stamp) -> Mesh:
    path = stamp[0]
    if path.suffix.lower() == ".3mf":
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST_FILE:
                raise UnusableShape(too_large(path))
    transform, unit = _root_transform(path), _unit(path)
    # Use a new loader every time, because a loader keeps all meshes in memory.  The loader builds bounding volumes,
    # which are not used, so it gets the type that is built fastest, ``BV_AABB``.
    shape = coal.MeshLoader(coal.BV_AABB).load(str(path), np.ones(3))
    points, triangles = mesh_points(shape), mesh_triangles(shape)
    if len(points) > max(_MOST_VERTICES, stamp[1]):
        raise UnusableShape(f"{path} repeats its parts, which gives {len(points)} vertices; simplify the mesh")
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise ValueError("the triangles name vertices that do not exist")
    if transform is not None:
        points = points @ transform[:3, :3].T + transform[:3, 3]
    return Mesh(points, renumbered(len(points), triangles), unit)


def too_large(path: Path) -> str:
    """Return the message about a mesh file larger than :data:`LARGEST_FILE`."""
    return f"{path} is larger than {LARGEST_FILE // 1_000_000} MB; simplify the mesh"


def _unit(path: Path) -> float:
    tag = _UNIT_TAGS.get(path.suffix.lower())
    stated = re.search(tag, _head(path)) if tag else None
    text = "1" if stated is None else stated[1].decode("latin-1").strip().lower()
    with suppress(ValueError):
        unit = _UNITS.get(text) or float(text)
        return unit if 0 < unit < float("inf") else 1.0
    return 1.0


def states_y_up(path: Path) -> bool:
    """Return whether a mesh is a COLLADA file which states that the y axis is up."""
    return path.suffix.lower() == ".dae" and b"<up_axis>Y_UP" in _head(path)


def _head(path: Path) -> bytes:
    """Return the first bytes of a mesh file, or of the model inside a 3MF archive."""
    with open_regular(path) as file:
        if path.suffix.lower() != ".3mf":
            return file.read(_HEAD)
        with zipfile.ZipFile(file) as archive:
            models = [name for name in archive.namelist() if name.endswith(".model")]
            return archive.open(models[0]).read(_HEAD) if models else b""


def _root_transform(path: Path) -> Array | None:
    """Return the transform that coal leaves out: of the single root node of a glTF file, shape (4, 4).

    Return ``None`` for other files, and for a root node that coal reads correctly.
    """
    if path.suffix.lower() not in (".gltf", ".glb"):
        return None
    data = read_bytes(path)
    end = 20 + int.from_bytes(data[12:16], "little") if data.startswith(b"glTF") else 0
    if end > len(data):  # The mesh library would allocate as many bytes as the file states.
        raise ValueError("the file ends too early")
    content = json.loads(data[20:end] if end else data)
    roots = [
        content["nodes"][k] for scene in content["scenes"][content.get("scene", 0) :][:1] for k in scene["nodes"]
    ]
    root = roots[0] if len(roots) == 1 else {}
    if "mesh" in root or not {"matrix", "rotation", "scale", "translation"} & root.keys():
        return None
    if "matrix" in root:
        return np.array(root["matrix"], dtype=float).reshape(4, 4).T
    transform = np.eye(4)
    rotation = pin.Quaternion(np.array(root.get("rotation", [0.0, 0.0, 0.0, 1.0]), dtype=float)).normalized()
    transform[:3, :3] = rotation.matrix() * root.get("scale", [1.0, 1.0, 1.0])
    transform[:3, 3] = root.get("translation", [0.0, 0.0, 0.0])
    return transform
