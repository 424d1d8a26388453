"""Contact point or sole of a foot, from the primitive collision shapes of its URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from impact_posture.robot.guessed_parts import joints_to, upright_frames
from impact_posture.robot.mjcf_geoms import geoms_of
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.robot.support_polygon import polygon_edges
from impact_posture.robot.urdf import quiet_stderr
from impact_posture.system.arrays import Array

# Points of a foot up to this height (m) above its lowest point also touch the ground.
_PATCH = 2e-3
# A contact area narrower than this (m) is treated as a point.
_SOLE = 0.01
# Cosine of the largest tilt of an upright sole frame, 1°.
_UPRIGHT = float(np.cos(np.radians(1.0)))


def support(robot: Robot, frame: str, urdf: Path, *, flat: bool) -> Support:
    """Return a foot; its boxes, cylinders and balls determine its contact point or sole.

    A foot without such shapes becomes a surface if ``flat``, else a point.
    """
    data, index = upright_frames(robot), robot.frame_id(frame)
    points = _lowest_points(robot, data, index, urdf)
    foot = Support(frame=frame, kind="surface" if flat else "point")
    if not len(points):
        return foot
    placement = data.oMf[index]
    patch = np.array([placement.actInv(p) for p in points if p[2] <= points[:, 2].min() + _PATCH])
    low, high = patch.min(axis=0), patch.max(axis=0)
    size = (high - low)[:2] / 2
    wide = len(patch) > 2 and size.min() > _SOLE / 2 and placement.rotation[2, 2] > _UPRIGHT
    middle = (low + high) / 2 if wide else patch.mean(axis=0)
    x, y, z, half_x, half_y = (round(float(v), 4) + 0.0 for v in (*middle, *size))
    foot = replace(foot, offset=(x, y, z))
    return replace(foot, kind="surface", size=(half_x, half_y)) if wide else foot


def foot_specs(robot: Robot, feet: Sequence[str], urdf: Path) -> list[Support]:
    """Return the feet as supports.  Two feet on legs of six or more joints are assumed to be flat."""
    flat = len(feet) == 2
    return [support(robot, f, urdf, flat=flat and len(joints_to(robot, f)) > 5) for f in feet]


def support_depth(robot: Robot, feet: Sequence[Support]) -> float:
    """Return the distance from the center of mass to the support polygon's edges, m; negative if outside."""
    model, q = robot.model, robot.posture()
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    center = np.array(pin.centerOfMass(model, data, q))[:2]
    corners = [
        data.oMf[robot.frame_id(foot.frame)].act(foot.offset + np.array([*foot.size, 0.0]) * (x, y, 0))[:2]
        for foot in feet
        for x, y in product((-1, 1), repeat=2)
    ]
    edges = polygon_edges(corners)
    return -1.0 if edges is None else float(np.min(edges[1] - edges[0] @ center))


def _lowest_points(robot: Robot, data: pin.Data, index: int, urdf: Path) -> Array:
    """Return world points on the undersides of the boxes, cylinders and balls that move with a frame.

    The meshes of an MJCF are already loaded, so their corners are among the points.
    """
    joint = robot.model.frames[index].parentJoint
    if robot.mjcf is not None:
        return np.array(list(_geom_points(robot, data, joint))).reshape(-1, 3)
    root = ET.parse(urdf).getroot()
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            if collision.find("geometry/mesh") is not None:
                link.remove(collision)
    with quiet_stderr():
        shapes = pin.buildGeomFromUrdfString(robot.model, ET.tostring(root, "unicode"), pin.GeometryType.COLLISION)
    moving = [shape for shape in shapes.geometryObjects if shape.parentJoint == joint]
    points = [point for shape in moving for point in _bottom(shape.geometry, data.oMi[joint] * shape.placement)]
    return np.array(points).reshape(-1, 3)


def _geom_points(robot: Robot, data: pin.Data, joint: int) -> Iterator[Array]:
    for geom in () if robot.mjcf is None else geoms_of(robot.mjcf.model):
        frame = robot.model.frames[robot.frame_id(geom.body)]
        if frame.parentJoint != joint or not geom.solid:
            continue
        at = data.oMi[joint] * frame.placement * geom.placement
        if geom.kind == "mesh":
            yield from geom.mesh[0] @ at.rotation.T + at.translation
        elif geom.kind == "capsule":
            radius, length = geom.sizes
            for side in (-0.5, 0.5):
                yield from _bottom(coal.Sphere(radius), at * pin.SE3(np.eye(3), np.array([0.0, 0.0, side * length])))
        elif geom.kind in ("sphere", "box", "cylinder"):
            yield from _bottom(getattr(coal, geom.kind.capitalize())(*geom.sizes), at)


def _bottom(shape: Any, at: pin.SE3) -> Sequence[Array]:
    """Return points of a box, cylinder or ball; the lowest points are among them."""
    match shape:
        case coal.Sphere():
            return [at.translation - [0, 0, shape.radius]]
        case coal.Box():
            return [at.act(np.array(signs) * shape.halfSide) for signs in product((-1, 1), repeat=3)]
        case coal.Cylinder():
            axis = np.array(at.rotation[:, 2])
            down = np.array([0, 0, -1.0]) + axis[2] * axis
            reach = float(np.linalg.norm(down))
            edge = shape.radius * down / reach if reach > 1e-9 else np.zeros(3)
            return [at.translation + sign * shape.halfLength * axis + edge for sign in (-1, 1)]
    return []
