"""The shapes of a robot as Pinocchio and coal take them."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.collision.pairs import pairs_apart
from impact_posture.collision.urdf_shapes import (
    UnusableShape,
    UrdfShape,
    disabled_links,
    largest_extent,
    left_out,
)
from impact_posture.libraries import source_key
from impact_posture.robot.robot import Robot


class Geometry(NamedTuple):
    """The shapes of a robot.

    Attributes:
        model: The shapes at their joints, without pairs.
        links: Link of each shape.
        apart: Whether two shapes have to keep apart by the joints and the SRDF, shape (n, n).
        warnings: Shapes left out, one line each.
    """

    model: pin.GeometryModel
    links: tuple[str, ...]
    apart: NDArray[np.bool_]
    warnings: tuple[str, ...]


def load_geometry(robot: Robot, described: list[UrdfShape]) -> Geometry:
    """Load the shapes that a URDF describes; a mesh that cannot be used is left out with a warning."""
    model, geometry, largest = robot.model, pin.GeometryModel(), largest_extent(robot)
    links, warnings = [], []
    for shape in described:
        try:
            solid = shape.load(largest)
        except UnusableShape as fault:
            warnings.append(left_out(shape.name, fault))
            continue
        index = model.getFrameId(shape.link, pin.FrameType.BODY)
        frame = model.frames[index]
        placement = frame.placement * shape.placement
        geometry.addGeometryObject(pin.GeometryObject(shape.name, frame.parentJoint, index, placement, solid))
        links.append(shape.link)
    joints = [int(solid.parentJoint) for solid in geometry.geometryObjects]
    apart = pairs_apart(model, joints, links, disabled_links(robot))
    return Geometry(geometry, tuple(links), apart, tuple(warnings))


def geometry_key(robot: Robot, described: list[UrdfShape]) -> str:
    """Return a hash of everything that shapes the swept hulls of a robot and their pairs."""
    model = robot.model
    content = [coal.__version__]
    for shape in described:
        content.append(repr((shape.name, shape.link, shape.kind, shape.sizes, shape.placement.homogeneous.tolist())))
        if shape.mesh is not None:
            with shape.mesh.open("rb") as file:
                content.append(hashlib.file_digest(file, "sha256").hexdigest())
    content += sorted(" ".join(sorted(pair)) for pair in disabled_links(robot))
    content += [f"{f.name} {f.parentJoint} {f.placement.homogeneous.tolist()}" for f in model.frames]
    for joint, parent, placement in zip(model.joints, model.parents, model.jointPlacements, strict=True):
        content.append(f"{joint.shortname()} {parent} {placement.homogeneous.tolist()}")
    limits = (model.lowerPositionLimit, model.upperPositionLimit)
    content += [repr([v.tolist() for v in (*limits, *robot.postures.values())]), robot.default_posture]
    return source_key(content, "collision")
