"""Check the shapes in the URDF for collisions with coal."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from impact_posture.collision.robot_shapes import RobotShapes
from impact_posture.collision.swept_hull import SweptHull, transform
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array

TOLERANCE = 1e-6
"""Largest penetration (m) that is not treated as a collision, because solvers let hulls touch within a tolerance."""

Standing = tuple[SweptHull, pin.SE3, Collection[int]]
"""An obstacle: its hull, its placement in the world, and the joints whose shapes may touch it."""


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """The half-space behind a plane, given by a point (m) and the unit normal out of the half-space, in world axes.

    Links of the joints ``exempt`` may be behind the plane.
    """

    name: str
    point: Array
    normal: Array
    exempt: Collection[int]


class MeshCheck:
    """Collision check of the shapes of a robot, prepared for many postures.

    Overlaps of less than 1 µm are ignored.  Meshes are surfaces, so a mesh entirely inside another does not collide.
    ``groups`` may contain a group number for each joint.  Shapes of the same group may touch, because held joints fix
    them to each other.
    """

    def __init__(self, robot: Robot, shapes: RobotShapes, groups: Sequence[int] = ()) -> None:
        self._model, self._geometry = robot.model, shapes.geometry
        self._data, self._placed = robot.model.createData(), shapes.geometry.createData()
        self._shapes = list(shapes.geometry.geometryObjects)
        for shape in self._shapes:
            shape.geometry.computeLocalAABB()
        self._joints = [int(shape.parentJoint) for shape in self._shapes]
        self._groups = [groups[k] for k in self._joints] if groups else range(len(self._shapes))
        # A ball around each shape, with its center in the axes of the joint.
        self._centers = [shape.placement.act(shape.geometry.aabb_center) for shape in self._shapes]
        self._reach = np.array([shape.geometry.aabb_radius for shape in self._shapes])

    def collisions(
        self, q: Array, obstacles: Sequence[Standing] = (), planes: Sequence[HalfSpace] = ()
    ) -> list[tuple[str, str]]:
        """Return the names of the two shapes of each collision at posture ``q``, shape (nq,).

        The shapes must not touch each other or the obstacles, and must stay in front of the planes.
        """
        collisions, shapes = [], self._shapes
        if pin.computeCollisions(self._model, self._data, self._geometry, self._placed, q, False):
            for pair, result in zip(self._geometry.collisionPairs, self._placed.collisionResults, strict=True):
                i, j = pair.first, pair.second
                if self._groups[i] == self._groups[j]:
                    continue
                if result.isCollision() and _deep(shapes[i].geometry, self._at(i), shapes[j].geometry, self._at(j)):
                    collisions.append((shapes[i].name, shapes[j].name))
        if not shapes:
            return collisions
        centers = np.array([self._data.oMi[k].act(at) for k, at in zip(self._joints, self._centers, strict=True)])
        walls: list[tuple[str, Any, pin.SE3]] = []
        near = [np.zeros((len(shapes), 0), dtype=bool)]
        for hull, at, exempt in obstacles:
            solid, local = hull.solid
            walls.append((hull.name, solid, at * local))
            away = np.linalg.norm(centers - at.act(hull.center), axis=1) - hull.reach
            near.append(self._within(away, exempt))
        for plane in planes:
            normal = np.asarray(plane.normal, dtype=float)
            height = float(normal @ plane.point)
            walls.append((plane.name, coal.Halfspace(normal, height), pin.SE3.Identity()))
            near.append(self._within(centers @ normal - height, plane.exempt))
        for k, wall in np.argwhere(np.hstack(near)):
            name, solid, where = walls[wall]
            if _deep(shapes[k].geometry, self._at(k), solid, where):
                collisions.append((shapes[k].name, name))
        return collisions

    def _at(self, index: int) -> pin.SE3:
        return self._data.oMi[self._joints[index]] * self._shapes[index].placement

    def _within(self, away: Array, exempt: Collection[int]) -> Array:
        """Return, as a column, whether the ball around each shape reaches a body at the distance ``away``."""
        allowed = np.array([joint not in exempt for joint in self._joints])
        return np.asarray((away <= self._reach) & allowed)[:, None]


def _deep(a: Any, at_a: pin.SE3, b: Any, at_b: pin.SE3) -> bool:
    """Return whether two shapes still collide after they are moved apart by the tolerance."""
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
