"""Shapes of a robot for the 3-D view of a report: simplified meshes, and their licenses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated

import coal
import numpy as np
import pinocchio as pin
from pydantic import PlainSerializer, PlainValidator

from impact_posture.collision.coal_geometry import geometry_key, load_geometry, read_shapes
from impact_posture.collision.shape_corners import Triangles, hull_surface, shape_points, surface_of
from impact_posture.collision.urdf_shapes import LinkShape
from impact_posture.config.cached_values import StoredArray, cached
from impact_posture.errors import PackageNotFound
from impact_posture.output.plot.skeleton import link_tip
from impact_posture.robot.robot import Robot
from impact_posture.robot.urdf import example_robot_data
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import source_key
from impact_posture.system.text_files import open_regular, read_bytes

# Maximum number of triangles of all meshes on a page.  More triangles would make the page large, and slow to draw
# without a GPU.
_MOST_TRIANGLES = 150_000
# Number of rounding steps in the largest extent of a mesh.
_LEVELS = 65535
_GRAY = (0.72, 0.74, 0.77, 1.0)
# Minimum of each color channel, because shading is not visible on darker colors.
_DARKEST = 0.2
# Triangles of a box.  Bit i of the corner number is 1 if the corner is at the upper end of axis i.
_BOX_FACES = np.array(
    [[0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4], [2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4, 6, 1, 3, 5, 3, 7, 5]],
    dtype=np.uint32,
).reshape(-1, 3)
# Colors are searched only in this number of bytes at the beginning of a COLLADA file.
_HEAD = 200_000

Color = tuple[float, ...]
_Placement = Annotated[
    pin.SE3, PlainValidator(lambda rows: pin.SE3(np.array(rows))), PlainSerializer(lambda at: at.homogeneous.tolist())
]


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangle mesh with rounded corners.

    Attributes:
        corners: Offsets of the corners from ``low`` as integer multiples of ``step``, shape (k, 3).
        faces: Corner indices of each triangle, shape (n, 3).
        low: Lower corner of the bounding box, m, shape (3,).
        step: Size of a rounding step, m.
    """

    corners: StoredArray
    faces: StoredArray
    low: StoredArray
    step: float

    @property
    def points(self) -> Array:
        """Corners, m, shape (k, 3)."""
        return self.low + self.step * self.corners


@dataclass(frozen=True, eq=False)
class PlacedSolids:
    """Meshes and their placements.

    Attributes:
        solids: Meshes; several shapes may share a mesh.
        places: For each shape: its name, joint, index of its mesh, and placement relative to the joint.
        warnings: A line for each shape that is left out.
    """

    solids: tuple[Solid, ...]
    places: tuple[tuple[str, int, int, _Placement], ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class MeshLicense:
    """License of the meshes in a package, which is a folder in example-robot-data.

    Attributes:
        package: Name of the folder.
        license: Name of the license; empty if the package states no license.
        upstream: Address of the original meshes.
        text: Text of the license; empty if the package contains no license text.
    """

    package: str
    license: str
    upstream: str
    text: str

    @property
    def allows(self) -> bool:
        """Whether the license permits copies of simplified meshes."""
        return bool(self.license) and "-ND" not in self.license.upper()


@dataclass(frozen=True, eq=False)
class DrawnRobot:
    """Shapes of a robot for the 3-D view.

    Attributes:
        solids: Meshes; several shapes may share a mesh.
        parts: For each shape: joint, index of its mesh, placement relative to the joint, and color (RGB, opacity).
        licenses: Licenses of the meshes on the page.
        notes: A line for each replaced or missing shape.
    """

    solids: tuple[Solid, ...]
    parts: tuple[tuple[int, int, pin.SE3, Color], ...]
    licenses: tuple[MeshLicense, ...]
    notes: tuple[str, ...]


@lru_cache(maxsize=4)
def draw_robot(robot: Robot, meshes: bool = False) -> DrawnRobot:
    """Return the visual shapes of a robot.  Hulls replace meshes whose license does not permit copies.

    A robot without shapes is drawn as sticks.  If ``meshes`` is true, the user permits copies of all meshes.
    """
    described, warnings, _ = read_shapes(robot, "visual")
    by_name = {shape.name: shape for shape in described}
    known = {shape.name: license_of(shape.mesh) for shape in described if shape.kind == "mesh"}
    hulls = {name for name, terms in known.items() if not (meshes or (terms and terms.allows))}
    key = source_key([geometry_key(robot, described), repr(sorted(hulls))], "report")
    placed = cached("solids", key, PlacedSolids, lambda: _placed_solids(robot, described, hulls))
    parts = [(joint, k, at, _color(by_name[name])) for name, joint, k, at in placed.places]
    drawn = {name for name, *_ in placed.places}
    licenses = {terms.package: terms for name, terms in known.items() if terms and name in drawn - hulls}
    notes = [*warnings, *placed.warnings]
    if hulls & drawn:
        notes.append("convex hulls replace meshes, unless `meshes` allows copies of meshes in the page")
    solids = list(placed.solids)
    if not parts:
        solids, parts = _sticks(robot)
        notes.append("the robot has no shapes that can be drawn: sticks join its joints")
    return DrawnRobot(tuple(solids), tuple(parts), tuple(licenses.values()), tuple(notes))


def _placed_solids(robot: Robot, described: list[LinkShape], hulls: set[str]) -> PlacedSolids:
    loaded = load_geometry(robot, described)
    by_name = {shape.name: shape for shape in described}
    solids: dict[tuple[object, ...], Solid] = {}
    places = []
    for placed in loaded.model.geometryObjects:
        shape, hull = by_name[placed.name], placed.name in hulls
        # Shapes with the same file and scale share a mesh.
        key = (shape.key, hull)
        if key not in solids:
            solids[key] = hull_of(shape_points(placed.geometry)) if hull else _quantized(*surface_of(placed.geometry))
        places.append((placed.name, int(placed.parentJoint), list(solids).index(key), placed.placement))
    return PlacedSolids(tuple(_reduced(list(solids.values()))), tuple(places), loaded.warnings)


def hull_of(points: Array) -> Solid:
    """Return the convex hull of points."""
    return _quantized(*hull_surface(points))


def _quantized(points: Array, faces: Triangles) -> Solid:
    low = points.min(axis=0)
    step = max(float(np.ptp(points, axis=0).max()), 1e-9) / _LEVELS
    return _welded(Solid(np.round((points - low) / step).astype(np.uint16), faces, low, step), 0)


def _welded(solid: Solid, bits: int) -> Solid:
    """Merge corners that differ only in their last ``bits``, and remove triangles that become degenerate."""
    keys = (solid.corners >> bits).astype(np.int64) @ (1 << np.array([32, 16, 0]))
    _, first, merged = np.unique(keys, return_index=True, return_inverse=True)
    faces = merged[solid.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    # Sort corners by their first use, so that successive corners are close to each other and compress well.
    used, at = np.unique(faces, return_index=True)
    order = used[np.argsort(at)]
    renamed = np.empty(len(first), dtype=np.uint32)
    renamed[order] = np.arange(len(order))
    return Solid(solid.corners[first[order]], renamed[faces], solid.low, solid.step)


def _reduced(solids: list[Solid]) -> list[Solid]:
    """Merge corners within an increasing distance, until the meshes have at most ``_MOST_TRIANGLES`` triangles."""
    length = max((solid.step for solid in solids), default=0.0)
    while sum(len(solid.faces) for solid in solids) > _MOST_TRIANGLES:
        length *= 2
        bits = [max(int(np.log2(length / solid.step)), 0) for solid in solids]
        solids = [_coarser(solid, k) if k else solid for solid, k in zip(solids, bits, strict=True)]
    return solids


def _coarser(solid: Solid, bits: int) -> Solid:
    """Merge corners that differ only in their last ``bits``; return the bounding box if no triangle remains."""
    welded = _welded(solid, bits)
    if len(welded.faces):
        return welded
    ends = np.stack([solid.corners.min(axis=0), solid.corners.max(axis=0)])
    corners = np.stack([ends[np.arange(8) >> axis & 1, axis] for axis in range(3)], axis=1)
    return Solid(corners, _BOX_FACES, solid.low, solid.step)


def _sticks(robot: Robot) -> tuple[list[Solid], list[tuple[int, int, pin.SE3, Color]]]:
    """Return rods between successive joints, and a rod from the last joint of each chain to the tip of its link."""
    model = robot.model
    spans = [(int(model.parents[k]), np.array(model.jointPlacements[k].translation)) for k in range(1, model.njoints)]
    inner = {parent for parent, _ in spans}
    tips = [(k, link_tip(model, k)) for k in range(1, model.njoints) if k not in inner]
    spans += [(k, tip) for k, tip in tips if np.any(tip)]
    ball = shape_points(coal.Sphere(0.02 * max(0.1, *(float(np.linalg.norm(span)) for _, span in spans))))
    rods = [hull_of(np.vstack([ball, ball + span])) for _, span in spans]
    return rods, [(parent, k, pin.SE3.Identity(), _GRAY) for k, (parent, _) in enumerate(spans)]


def _color(shape: LinkShape) -> Color:
    """Return the color in the URDF, or the mean color in a COLLADA file (coal does not read colors), or gray."""
    *color, opacity = shape.color or _GRAY
    if shape.color is None and shape.mesh is not None and shape.mesh.suffix.lower() == ".dae":
        with open_regular(shape.mesh) as file:
            head = file.read(_HEAD)
        colors = re.findall(rb"<diffuse>\s*<color[^>]*>\s*([\d.eE+-]+)\s+([\d.eE+-]+)\s+([\d.eE+-]+)\s", head)
        color = np.mean([[float(v) for v in values] for values in colors] or [color], axis=0).tolist()
    return (*np.clip(color, _DARKEST, 1.0).tolist(), opacity)


def license_of(mesh: Path | None) -> MeshLicense | None:
    """Return the license of a mesh in example-robot-data; ``None`` for other meshes."""
    if mesh is None:
        return None
    try:
        root = example_robot_data().resolve()
    except PackageNotFound:
        return None
    path = mesh.resolve()
    return _read_license(root / path.relative_to(root).parts[0]) if path.is_relative_to(root) else None


@cache
def _read_license(folder: Path) -> MeshLicense:
    readme, text = (
        read_bytes(path).decode(errors="replace") if path.is_file() else ""
        for path in (folder / "README.md", folder / "LICENSE")
    )
    matches = (re.search(rf"^{key}:\s*(\S.*)$", readme, re.I | re.M) for key in ("license", "upstream"))
    license, upstream = ("" if match is None else match[1].strip() for match in matches)
    return MeshLicense(folder.name, license, upstream, text)
