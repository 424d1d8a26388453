"""Load the shapes of a robot into Pinocchio and coal."""

from __future__ import annotations

from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.collision.mesh_file import UnusableShape, read_meshes
from impact_posture.collision.mjcf_shapes import mjcf_shapes
from impact_posture.collision.shape_corners import Corrected, shape_points
from impact_posture.collision.shape_pairs import disabled_links, pairs_apart
from impact_posture.collision.urdf_shapes import LinkShape, LinkShapes, largest_extent, left_out, read_urdf_shapes
from impact_posture.errors import one_line
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import source_key

# Rotation that turns the y axis of a mesh upwards.
_UPRIGHT = pin.SE3(pin.rpy.rpyToMatrix(np.pi / 2, 0.0, 0.0), np.zeros(3))


class Geometry(NamedTuple):
    """The shapes of a robot at their joints, without pairs, and the link of each shape.

    ``apart``, shape (n, n), tells whether two shapes must not touch.  ``warnings`` has one line for each shape that
    is left out or changed.
    """

    model: pin.GeometryModel
    links: tuple[str, ...]
    apart: NDArray[np.bool_]
    warnings: tuple[str, ...]


def read_shapes(robot: Robot, first: str = "collision") -> LinkShapes:
    """Return the shapes in the URDF or MJCF of a robot; ``first`` selects its ``collision`` or ``visual`` shapes."""
    return read_urdf_shapes(robot, first) if robot.mjcf is None else mjcf_shapes(robot.mjcf.model, first)


def load_geometry(robot: Robot, described: list[LinkShape]) -> Geometry:
    """Load the shapes in a URDF; leave out unusable shapes with a warning."""
    model, largest = robot.model, largest_extent(robot)
    kept, solids, warnings = [], [], []
    read_meshes(shape.mesh for shape in described if shape.mesh is not None)
    # Load a mesh that several limbs share only once, because loading may take a tenth of a second.
    loaded: dict[object, Corrected] = {}
    for shape in described:
        try:
            if shape.key not in loaded:
                loaded[shape.key] = shape.load(largest)
            solids.append(loaded[shape.key].mesh)
            kept.append(shape)
            if not loaded[shape.key].exact:
                why = f"the parts of {shape.mesh} cannot be separated; export it as one part"
                warnings.append(one_line(f"shape {shape.name} is replaced by its convex hull: {why}"))
        except UnusableShape as fault:
            warnings.append(left_out(shape.name, fault))
    objects = _placed(model, kept, solids, turned=False)
    if any(shape.y_up for shape in kept):
        turned = _placed(model, kept, solids, turned=True)
        if _gaps(model, turned) < _gaps(model, objects) / 2:
            objects = turned
            warnings.append("meshes with y up are turned to z up, because the links reach their joints only then")
    geometry = pin.GeometryModel()
    for solid in objects:
        geometry.addGeometryObject(solid)
    links = tuple(shape.link for shape in kept)
    apart = pairs_apart(model, [int(solid.parentJoint) for solid in objects], links, disabled_links(robot))
    return Geometry(geometry, links, apart, tuple(warnings))


def _placed(
    model: pin.Model, shapes: list[LinkShape], solids: list[Any], *, turned: bool
) -> list[pin.GeometryObject]:
    """Return the shapes at their joints; if ``turned``, meshes whose files state that the y axis is up are rotated.

    Most URDFs expect meshes that are not rotated, because ROS ignores the up axis in COLLADA files.
    """
    objects = []
    for shape, solid in zip(shapes, solids, strict=True):
        index = model.getFrameId(shape.link, pin.FrameType.BODY)
        frame = model.frames[index]
        placement = frame.placement * shape.placement * (_UPRIGHT if turned and shape.y_up else pin.SE3.Identity())
        objects.append(pin.GeometryObject(shape.name, frame.parentJoint, index, placement, solid))
    return objects


def _gaps(model: pin.Model, objects: list[pin.GeometryObject]) -> float:
    """Return the sum of distances (m) from the joints to the boxes around the shapes of their parent links."""
    boxes: dict[int, list[Array]] = {}
    for solid in objects:
        points = shape_points(solid.geometry) @ solid.placement.rotation.T + solid.placement.translation
        boxes.setdefault(int(solid.parentJoint), []).append(np.array([points.min(axis=0), points.max(axis=0)]))
    total = 0.0
    for parent, placement in zip(model.parents, model.jointPlacements, strict=True):
        point = np.array(placement.translation)
        total += min(
            (float(np.linalg.norm(point - np.clip(point, *box))) for box in boxes.get(int(parent), [])), default=0
        )
    return total


def geometry_key(robot: Robot, described: list[LinkShape]) -> str:
    """Return a hash of all data that determine the swept hulls of a robot and the pairs that must not touch."""
    content = [coal.__version__, robot.kinematics_sha256]
    for shape in described:
        content.append(repr((shape.name, shape.link, shape.kind, shape.sizes, shape.placement.homogeneous.tolist())))
        content.append(shape.content)
    content += sorted(" ".join(sorted(pair)) for pair in disabled_links(robot))
    return source_key(content, "collision")
