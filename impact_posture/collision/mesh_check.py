"""The last word on collisions: coal, on the shapes of the URDF themselves."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any, Protocol

import coal
import numpy as np
import pinocchio as pin

from impact_posture.arrays import Array
from impact_posture.collision.shapes import RobotShapes
from impact_posture.collision.swept_hull import SweptHull, transform
from impact_posture.robot.robot import Robot

TOLERANCE = 1e-6
"""Depth (m) up to which two shapes may be in each other, because a solver lets hulls touch within its tolerance."""


Standing = tuple[SweptHull, Collection[int]]


class Plane(Protocol):
    """A plane that shapes stay in front of."""

    @property
    def name(self) -> str:
        """Name in messages."""

    @property
    def point(self) -> Array:
        """A point of the plane in the world, shape (3,), m."""

    @property
    def normal(self) -> Array:
        """Unit normal in world axes, shape (3,), towards the robot."""

    @property
    def exempt(self) -> Collection[int]:
        """Joints whose shapes may be behind the plane."""


def mesh_collisions(
    robot: Robot,
    shapes: RobotShapes,
    q: Array,
    obstacles: Sequence[Standing] = (),
    planes: Sequence[Plane] = (),
) -> list[tuple[str, str]]:
    """Return what collides at a posture, by the shapes of the URDF.

    A collision counts from a depth of 1 µm.  Meshes are surfaces: one that is wholly inside another does not collide.

    Args:
        robot: The robot.
        shapes: Its shapes.
        q: The posture, shape (nq,).
        obstacles: Swept hulls in the world, with joint 0, each with the joints whose shapes may touch it.
        planes: Planes that the shapes have to stay in front of.

    Returns:
        Names of two shapes, of a shape and an obstacle, or of a shape and a plane.
    """
    geometry, data = shapes.geometry, robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    objects = list(geometry.geometryObjects)
    at = [data.oMi[shape.parentJoint] * shape.placement for shape in objects]
    placed = geometry.createData()
    pin.computeCollisions(robot.model, data, geometry, placed, q, False)
    found = []
    for pair, result in zip(geometry.collisionPairs, placed.collisionResults, strict=True):
        i, j = pair.first, pair.second
        if result.isCollision() and _deep(objects[i].geometry, at[i], objects[j].geometry, at[j]):
            found.append((objects[i].name, objects[j].name))
    for shape, placement in zip(objects, at, strict=True):
        for name, solid, where in _scene(obstacles, planes, int(shape.parentJoint)):
            if _deep(shape.geometry, placement, solid, where):
                found.append((shape.name, name))
    return found


def _scene(obstacles: Sequence[Standing], planes: Sequence[Plane], joint: int) -> Iterator[tuple[str, Any, pin.SE3]]:
    """Yield name, shape and placement of everything that the shapes of a joint stay clear of."""
    for obstacle, exempt in obstacles:
        if joint not in exempt:
            yield obstacle.name, *obstacle.solid
    for plane in planes:
        if joint not in plane.exempt:
            normal = np.asarray(plane.normal, dtype=float)
            yield plane.name, coal.Halfspace(normal, float(normal @ plane.point)), pin.SE3.Identity()


def _deep(a: Any, at_a: pin.SE3, b: Any, at_b: pin.SE3) -> bool:
    """Tell whether two shapes still collide after a move by the tolerance out of each other."""
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    if not coal.collide(a, transform(at_a), b, transform(at_b), request, result):
        return False
    normal = np.array(result.getContact(0).normal)
    if not np.isfinite(normal).all():
        return True
    for side in (-1, 1):
        moved = pin.SE3(at_a.rotation, at_a.translation + side * TOLERANCE * normal)
        if not coal.collide(a, transform(moved), b, transform(at_b), request, coal.CollisionResult()):
            return False
    return True
