"""The foremost point of the links that move with a contact frame: the point that touches a surface first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import coal
import numpy as np
import pinocchio as pin

from impact_posture.collision.coal_geometry import geometry_key, load_geometry, read_shapes
from impact_posture.collision.shape_corners import ends, shape_points
from impact_posture.collision.swept_hull import hull_corners
from impact_posture.collision.urdf_shapes import LinkShape
from impact_posture.config.cached_values import StoredArray, cached
from impact_posture.config.demand import Vector3
from impact_posture.robot.model_joints import rigid_groups
from impact_posture.robot.robot import Robot
from impact_posture.robot.support_polygon import nearest_in_hull
from impact_posture.system.arrays import Array

# Points behind the foremost point by less than this value (m) belong to the same flat front.
_FLAT = 5e-4
# Number of corners of the polygon around a flat front.
_SIDES = 64


@dataclass(frozen=True)
class ContactFront:
    """The foremost point, along a given direction, of the links that move with a contact frame.

    If several points are foremost (a flat front), the point nearest to the line through the origin of the frame along
    the direction is used.

    Attributes:
        link: Link with the foremost point.
        offset: The foremost point in the coordinates of the contact frame, shape (3,), m.
        reach: Distance from the contact point to the foremost point along the direction, m.
    """

    link: str
    offset: Vector3
    reach: float


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Convex hull that contains a shape, given by corners, and by a ball and a disk around each corner.

    Attributes:
        link: Link of the shape.
        corners: Corners in the axes of the joint that carries the link, shape (k, 3), m.
        ball: Radius of the balls, m.
        disk: Vector along the axis of the disks, with the length of their radius, in the axes of the joint, shape
            (3,), m.
    """

    link: str
    joint: int
    corners: StoredArray
    ball: float
    disk: StoredArray

    def foremost(self, direction: Array) -> Array:
        """Return points, including all foremost points along a unit direction, in axes of the joint, shape (k, 3)."""
        points = self.corners + self.ball * direction
        radius = float(np.linalg.norm(self.disk))
        if radius == 0:
            return points
        axis = self.disk / radius
        ahead = direction - (direction @ axis) * axis
        if np.linalg.norm(ahead) < 1e-9:
            ahead = np.linalg.svd(axis[None])[2][1]
        ahead = ahead / np.linalg.norm(ahead)
        turns = np.arange(_SIDES) * 2 * np.pi / _SIDES
        rim = radius * (np.outer(np.cos(turns), ahead) + np.outer(np.sin(turns), np.cross(axis, ahead)))
        return np.asarray((points[:, None] + rim[None]).reshape(-1, 3))


def contact_front(
    robot: Robot,
    q: Array,
    frame: str,
    offset: Vector3,
    direction: Array,
    held: Sequence[str] = (),
    *,
    in_world: bool = False,
) -> ContactFront | None:
    """Return the front of the links that do not move relative to a contact frame; ``None`` if they have no shapes.

    The front belongs to the link of the frame, the links welded to this link, and the links behind joints that do not
    move.  The function uses the collision shapes of a link, or its visual shapes if it has no collision shapes.

    Args:
        robot: The robot with its shapes.
        q: Posture, shape (nq,).
        frame: Contact frame.
        offset: Contact point in the coordinates of the frame, shape (3,), m.
        direction: Direction towards the surface, ``−n``, shape (3,).
        held: Joints that do not move.
        in_world: Whether the direction is in world axes instead of the axes of the frame.
    """
    carrier = robot.model.frames[robot.frame_id(frame)]
    shapes = rigid_silhouettes(robot, int(carrier.parentJoint), tuple(held))
    if not shapes:
        return None
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    to_frame = (data.oMi[carrier.parentJoint] * carrier.placement).inverse()
    d = (to_frame.rotation if in_world else np.eye(3)) @ direction / np.linalg.norm(direction)
    points, owners = [], list[str]()
    for shape in shapes:
        at = to_frame * data.oMi[shape.joint]
        points.append(shape.foremost(at.rotation.T @ d) @ at.rotation.T + at.translation)
        owners += [shape.link] * len(points[-1])
    corners = np.vstack(points)
    heights = corners @ d
    most = float(heights.max())
    near = corners[heights > most - _FLAT]
    x, y, z = (float(v) for v in nearest_in_hull(near - np.outer(near @ d, d)) + most * d)
    return ContactFront(owners[int(heights.argmax())], (x, y, z), most - float(np.dot(offset, d)))


@lru_cache(maxsize=64)
def rigid_silhouettes(robot: Robot, joint: int, held: tuple[str, ...] = ()) -> tuple[Silhouette, ...]:
    """Return the shapes of the links that do not move relative to the link of a joint while ``held`` joints rest.

    The function reads only the meshes of these links, and caches the result on disk.
    """
    described = read_shapes(robot)[0]
    group = rigid_groups(robot.model, held)
    near = [shape for shape in described if group[_joint(robot, shape.link)] == group[joint]]
    if not near:
        return ()
    # The shapes of all links determine whether meshes with y up are turned.
    needed = described if any(shape.y_up for shape in near) else near
    key, make = geometry_key(robot, needed), partial(_silhouettes, robot, needed)
    stored = cached("silhouettes", key, tuple[Silhouette, ...], make)
    return tuple(shape for shape in stored if group[shape.joint] == group[joint])


def _joint(robot: Robot, link: str) -> int:
    return int(robot.model.frames[robot.model.getFrameId(link, pin.FrameType.BODY)].parentJoint)


def _silhouettes(robot: Robot, described: list[LinkShape]) -> tuple[Silhouette, ...]:
    loaded, result = load_geometry(robot, described), []
    for link, solid in zip(loaded.links, loaded.model.geometryObjects, strict=True):
        shape, at = solid.geometry, solid.placement
        ball, disk = 0.0, np.zeros(3)
        match shape:
            case coal.Sphere():
                corners, ball = np.zeros((1, 3)), float(shape.radius)
            case coal.Capsule():
                corners, ball = ends(np.zeros((1, 3)), shape.halfLength), float(shape.radius)
            case coal.Cylinder():
                corners, disk = ends(np.zeros((1, 3)), shape.halfLength), shape.radius * at.rotation[:, 2]
            case coal.Box():
                corners = shape_points(shape)
            case _:
                corners = hull_corners(shape_points(shape))
        placed = corners @ at.rotation.T + at.translation
        result.append(Silhouette(link, int(solid.parentJoint), placed, ball, disk))
    return tuple(result)
