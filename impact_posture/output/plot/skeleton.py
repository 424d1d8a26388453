"""Sticks that represent a robot in figures, computed from its model, and the hulls of its collision shapes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.output.plot.ellipsoid_shapes import cone_rim
from impact_posture.output.plot.silhouette import PlacedHull, place_hulls
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# Minimum height of the drawn body as a share of its shorter side.
_LEAST_HEIGHT = 0.35
# Two axes count as parallel if the sine of their angle is at most this number.
_PARALLEL = 1e-3
_AROUND = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Sticks of a robot in a posture, in world coordinates, m.

    Attributes:
        bones: End points of the sticks, shape (k, 2, 3).
        joints: Origins of the moving joints, shape (j, 3).
        base: Placement of the floating base; the identity for a fixed base.
        body: Corners of the box around the hips, low corners first, shape (8, 3); (0, 3) without a box.
        contacts: Impact contact points, shape (c, 3).
        normals: Unit normals at the contact points, shape (c, 3).
        feet: Contact points of the supports, shape (f, 3).
        rotors: Circles of the propellers, shape (r, 3, points).
        hulls: Hulls of the collision shapes; empty for a robot without shapes.
        across: Unit normal of the plane of a planar robot, shape (3,); ``None`` for other robots.
    """

    bones: Array
    joints: Array
    base: pin.SE3
    body: Array
    contacts: Array
    normals: Array
    feet: Array
    rotors: Array
    hulls: tuple[PlacedHull, ...] = ()
    across: Array | None = None

    @property
    def contact(self) -> Array:
        """The first contact point, shape (3,)."""
        return np.asarray(self.contacts[0])

    @property
    def normal(self) -> Array:
        """Unit normal at the first contact point, shape (3,)."""
        return np.asarray(self.normals[0])

    @property
    def arms(self) -> Array:
        """Lines from the base to the centers of the rotors, shape (r, 2, 3)."""
        centers = self.rotors.mean(axis=2)
        return np.stack([np.broadcast_to(np.asarray(self.base.translation), centers.shape), centers], axis=1)

    @property
    def points(self) -> Array:
        """All points that must be inside the figure, shape (m, 3)."""
        circles = self.rotors.transpose(0, 2, 1).reshape(-1, 3)
        origin = np.asarray(self.base.translation)[None]
        shapes = [hull.vertices for hull in self.hulls] or [self.body]
        return np.vstack([self.bones.reshape(-1, 3), origin, *shapes, self.contacts, self.feet, circles])


def build_skeleton(
    robot: Robot,
    q: Array,
    contacts: Sequence[ImpactContact],
    supports: Sequence[Support] = (),
    collisions: Iterable[tuple[str, str]] = (),
) -> Skeleton:
    """Return the sticks at ``q``, shape (nq,).

    A stick joins the origins of a joint and its parent.  A base with at least four joints is drawn as a box.  Further
    sticks lead to contact points and feet.  A chain without contact point or foot ends with a stick to
    :func:`link_tip`.  ``collisions`` are pairs of names of colliding shapes.
    """
    model = robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    places = data.oMi
    first = 2 if robot.floating else 1
    base = pin.SE3(places[1]) if robot.floating else pin.SE3.Identity()
    origins = [np.zeros(3), *(np.array(places[i].translation) for i in range(1, model.njoints))]
    body = _body(model, base) if robot.floating else np.zeros((0, 3))
    bones = [
        (origins[model.parents[i]], origins[i])
        for i in range(first, model.njoints)
        if model.parents[i] >= first or not len(body)
    ]
    touching: list[ImpactContact | Support] = [*contacts, *supports]
    hanging = [point_on(robot, contact.frame, contact.offset) for contact in touching]
    frames = [places[point.joint] * pin.SE3(point.rotation, point.position) for point in hanging]
    ends = [np.array(frame.translation) for frame in frames]
    normals = [
        (np.asarray(frame.rotation) if contact.normal_frame == "contact" else np.eye(3)) @ np.array(contact.normal)
        for contact, frame in zip(contacts, frames, strict=False)
    ]
    bones += [
        (origins[point.joint], end)
        for point, end in zip(hanging, ends, strict=True)
        if point.joint >= first or not len(body)
    ]
    # A link that already has a stick to its foot or contact point gets no stick to its tip.
    done = {int(model.parents[i]) for i in range(1, model.njoints)}
    done |= {point.joint for point in hanging if np.linalg.norm(point.position) > 1e-3}
    for leaf in range(first, model.njoints):
        if leaf not in done:
            bones.append((origins[leaf], np.array(places[leaf].act(link_tip(model, leaf)))))
    return Skeleton(
        bones=np.array(bones),
        joints=np.array(origins[first:]).reshape(-1, 3),
        base=base,
        body=body,
        contacts=np.array(ends[: len(contacts)]),
        normals=np.array(normals),
        feet=np.array(ends[len(contacts) :]).reshape(-1, 3),
        rotors=_rotors(robot, places),
        hulls=place_hulls(robot, data, collisions),
        across=_across(model, q),
    )


def _across(model: pin.Model, q: Array) -> Array | None:
    """Return the unit normal of the plane in which all joints move; ``None`` if the robot is not planar."""
    # For a single joint, Pinocchio returns a vector instead of a matrix, hence reshape.
    linear, angular = np.split(pin.computeJointJacobians(model, model.createData(), q).reshape(6, -1), 2)
    _, sizes, directions = np.linalg.svd(angular.T)
    across = np.asarray(directions[0])
    turns = sizes[0] > _PARALLEL and not (sizes[1:] > _PARALLEL).any()
    return across if turns and np.abs(across @ linear).max() < _PARALLEL else None


def _body(model: pin.Model, base: pin.SE3) -> Array:
    """Return the corners of the box around the joints on the base; no corners for fewer than four joints."""
    hips = np.array([model.jointPlacements[i].translation for i in range(2, model.njoints) if model.parents[i] == 1])
    if len(hips) < 4:
        return np.zeros((0, 3))
    low, high = hips.min(axis=0), hips.max(axis=0)
    # If all hips have the same height, the box would be flat.  The model does not contain the height of the body.
    lacking = max(_LEAST_HEIGHT * float((high - low)[:2].min()) - float((high - low)[2]), 0.0)
    low[2], high[2] = low[2] - lacking / 2, high[2] + lacking / 2
    corners = [(x, y, z) for z in (low[2], high[2]) for x, y in _AROUND * (high - low)[:2] + low[:2]]
    return np.array([base.act(np.array(corner)) for corner in corners])


def link_tip(model: pin.Model, joint: int) -> Array:
    """Return the frame origin of a link farthest from its joint, or else the center of mass, in joint axes."""
    places = [np.array(f.placement.translation) for f in model.frames if f.parentJoint == joint]
    tip = max(places, key=lambda place: float(np.linalg.norm(place)), default=np.zeros(3))
    return tip if np.linalg.norm(tip) > 1e-3 else np.array(model.inertias[joint].lever)


def _rotors(robot: Robot, places: list[pin.SE3]) -> Array:
    propulsion = robot.spec.propulsion
    if propulsion is None:
        return np.zeros((0, 3, 24))
    frame = robot.model.frames[robot.frame_id(propulsion.frame)]
    place = places[frame.parentJoint] * frame.placement
    centers = [np.array(rotor.position) for rotor in propulsion.rotors]
    gaps = [float(np.linalg.norm(a - b)) for k, a in enumerate(centers) for b in centers[:k]]
    radius = 0.4 * min(gaps, default=0.5)
    circles = []
    for center, rotor in zip(centers, propulsion.rotors, strict=True):
        # Drop the last point, which is equal to the first.
        ring = cone_rim(np.array(rotor.direction) / np.linalg.norm(rotor.direction), 90.0, radius, 25)[:, :-1]
        circles.append(place.rotation @ (center[:, None] + ring) + np.asarray(place.translation)[:, None])
    return np.array(circles)
