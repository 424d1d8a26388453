"""Read the shapes of links from a URDF, and explain why a shape cannot be used."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple, TypeVar
from urllib.parse import unquote

import coal
import numpy as np
import pinocchio as pin

from impact_posture.collision.mesh_file import LARGEST_FILE, UnusableShape, read_mesh, states_y_up, too_large
from impact_posture.collision.shape_corners import Corrected, hull_surface, triangle_mesh
from impact_posture.config.text_parsers import finite_numbers
from impact_posture.errors import UrdfError, one_line
from impact_posture.robot.robot import Robot, RobotFiles
from impact_posture.robot.urdf import parse_urdf
from impact_posture.system.folder_record import sha256_of

# A shape is assumed not to be in meters if its extent exceeds both 5 m and ten times the extent of the robot.
_LARGEST = 5.0
_LARGEST_SHARE = 10.0
# Attributes with the sizes of each shape type, and the number of values in each attribute.
_SIZES = {
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
    "mesh": {"scale": 3},
}

_Part = TypeVar("_Part")


class LinkShapes(NamedTuple):
    """The shapes in a URDF or MJCF.

    Attributes:
        shapes: Shapes whose description can be used.
        warnings: A warning for each shape whose description cannot be used.
        described: Links for which the file describes a shape, even if no shape of the link can be used.
    """

    shapes: list[LinkShape]
    warnings: list[str]
    described: list[str]

    def add(self, link: str, parts: Sequence[_Part], read: Callable[[_Part, str], LinkShape]) -> None:
        """Add the shapes of a link; ``read(part, name)`` reads the shape ``name`` from a part of the file."""
        if parts:
            self.described.append(link)
        for k, part in enumerate(parts):
            name = link if len(parts) == 1 else f"{link}[{k}]"
            try:
                self.shapes.append(read(part, name))
            except UnusableShape as fault:
                self.warnings.append(left_out(name, fault))


@dataclass(frozen=True)
class LinkShape:
    """A shape of a link in a URDF or MJCF.

    Attributes:
        name: Unique name: the link, with ``[k]`` if the link has several shapes.
        placement: Placement in the axes of the link.
        kind: Tag of the URDF or type of the geom, such as ``box`` or ``mesh``.
        sizes: Sizes in the order of the URDF, m, or the scale of a mesh.
        color: Red, green, blue and opacity, 0 to 1; ``None`` if the file contains no color.
    """

    name: str
    link: str
    placement: pin.SE3
    kind: str
    sizes: tuple[float, ...]
    mesh: Path | None = None
    color: tuple[float, ...] | None = None

    @property
    def key(self) -> object:
        """Key in a cache of coal shapes."""
        return self.kind, self.sizes, self.mesh

    @property
    def content(self) -> str:
        """Hash of the mesh file; empty without a mesh."""
        return "" if self.mesh is None else sha256_of(self.mesh)

    @cached_property
    def y_up(self) -> bool:
        """Whether the mesh is a COLLADA file which states that the y axis is up."""
        return self.mesh is not None and states_y_up(self.mesh)

    def load(self, largest: float) -> Corrected:
        """Return the coal shape, and whether it is exact or a convex hull; reject shapes larger than ``largest`` (m).

        Raises:
            UnusableShape: The mesh cannot be read, is empty, has numbers that are not finite, or is not in meters.
        """
        if self.kind == "mesh":
            return self._load_mesh(largest)
        if max(self.sizes) > largest:
            raise UnusableShape(f"its <{self.kind}> has a size of {max(self.sizes):.3g} m; give sizes in meters")
        return Corrected(getattr(coal, self.kind.capitalize())(*self.sizes), True)

    def _load_mesh(self, largest: float) -> Corrected:
        points, triangles, unit = read_mesh(self.mesh or Path())
        points = points * (unit * np.array(self.sizes))
        if not np.isfinite(points).all():
            raise UnusableShape(f"{self.mesh} has vertices that are not finite; export it again")
        extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
        if extent <= 0:
            raise UnusableShape(f"{self.mesh} has no extent; export it again")
        if extent > largest:
            stated = f" with the unit of {unit:g} m that it states" if unit != 1 else ""
            hint = 'give its <mesh> a scale, such as scale="0.001 0.001 0.001" for millimeters'
            raise UnusableShape(f"{self.mesh} is {extent:.3g} m large{stated}, so it is not in meters; {hint}")
        surface = hull_surface(points) if triangles is None else (points, triangles)
        return Corrected(triangle_mesh(*surface), triangles is not None)


def largest_extent(robot: Robot) -> float:
    """Return the extent (m) above which a shape is not in meters: 5 m, or ten times the robot if this is larger."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.posture())
    points = [data.oMi[i].act(np.array(robot.model.inertias[i].lever)) for i in range(1, robot.model.njoints)]
    points += [np.array(data.oMi[i].translation) for i in range(1, robot.model.njoints)]
    return max(_LARGEST, _LARGEST_SHARE * float(np.linalg.norm(np.ptp(np.array(points), axis=0))))


def read_urdf_shapes(robot: Robot, first: str = "collision") -> LinkShapes:
    """Read the shapes in the URDF of a robot.

    If a link has both ``collision`` and ``visual`` shapes, only the shapes of the type ``first`` are read.

    Raises:
        UrdfError: The URDF has become unreadable, or its links differ from the links of the robot.
    """
    read, files = LinkShapes([], [], []), robot.files
    if files is None:
        return read
    root = parse_urdf(files.urdf)
    colors = {tag.get("name", ""): tag for tag in root.findall("material")}
    for link in root.findall("link"):
        name = link.get("name", "")
        if not robot.model.existFrame(name, pin.FrameType.BODY):
            raise UrdfError("has changed since the robot was loaded", where=str(files.urdf), hint="load it again")
        tags = link.findall(first) or link.findall("visual") or link.findall("collision")
        read.add(name, tags, partial(_read, link=name, files=files, colors=colors))
    return read


def left_out(name: str, fault: UnusableShape) -> str:
    """Return the warning about a shape that is left out."""
    return one_line(f"shape {name} is left out: {fault}")


def _read(tag: ET.Element, name: str, link: str, files: RobotFiles, colors: Mapping[str, ET.Element]) -> LinkShape:
    shape = next(iter(tag.findall("geometry/*")), None)
    if shape is None or shape.tag not in _SIZES:
        known = ", ".join(_SIZES)
        raise UnusableShape(f"its <geometry> is {'empty' if shape is None else f'<{shape.tag}>'}; give {known}")
    sizes: list[float] = []
    for attribute, count in _SIZES[shape.tag].items():
        text = shape.get(attribute) or ("1 1 1" if attribute == "scale" else "")
        sizes += _numbers(text, count, f"<{shape.tag} {attribute}>")
    if min(sizes) <= 0 and (shape.tag != "mesh" or 0.0 in sizes):
        raise UnusableShape(f"its <{shape.tag}> has a size of {min(sizes):g}; give sizes above zero")
    origin = tag.find("origin")
    xyz, rpy = (
        _numbers("0 0 0" if origin is None else origin.get(key, "0 0 0"), 3, f"<origin {key}>")
        for key in ("xyz", "rpy")
    )
    placement = pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy)), np.array(xyz))
    mesh = _find_mesh(shape.get("filename", ""), files) if shape.tag == "mesh" else None
    material = tag.find("material")
    return LinkShape(name, link, placement, shape.tag, tuple(sizes), mesh, _color(material, colors))


def _color(material: ET.Element | None, named: Mapping[str, ET.Element]) -> tuple[float, ...] | None:
    """Return the color in a material tag, or else in the named material; ``None`` without a valid color."""
    for tag in () if material is None else (material, named.get(material.get("name", ""))):
        color = None if tag is None else tag.find("color")
        if color is not None:
            with suppress(UnusableShape):
                return tuple(np.clip(_numbers(color.get("rgba", ""), 4, "<color rgba>"), 0.0, 1.0).tolist())
    return None


def _numbers(text: str, count: int, where: str) -> list[float]:
    if not (numbers := finite_numbers(text, count)):
        raise UnusableShape(f"its {where} is '{text}'; give {count} finite number{'s' if count > 1 else ''}")
    return numbers


def _find_mesh(text: str, files: RobotFiles) -> Path:
    """Return the file of a mesh; ``package://`` paths start from a package folder or a folder above the URDF."""
    scheme, colon, rest = text.partition("://")
    if scheme == "file":
        paths = [Path(unquote(rest))]
    else:
        above = (*files.folders, *files.urdf.absolute().parents)
        paths = [folder / rest for folder in above] if colon else [files.urdf.parent / text]
    for path in paths:
        if path.is_file():
            if not os.access(path, os.R_OK):
                raise UnusableShape(f"{path} cannot be read; change its permissions")
            if path.stat().st_size > LARGEST_FILE:
                raise UnusableShape(too_large(path))
            return path
    hint = "name the folder above the package with `package_dir`" if scheme == "package" else "correct the path"
    raise UnusableShape(f"no mesh '{text}'; {hint}")
