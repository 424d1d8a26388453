"""The bodies that the links of a robot must not touch: other links, the struck surface, the ground and obstacles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from impact_posture.collision.mesh_check import HalfSpace, MeshCheck
from impact_posture.collision.robot_shapes import load_shapes
from impact_posture.collision.swept_hull import SweptHull, obstacle_hull
from impact_posture.config.obstacle import Obstacle
from impact_posture.config.problem_settings import PATCH
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.errors import InputError, listed
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.impact.worst_case.worst_normal import cone_axes
from impact_posture.posture.constraints.clearance import Clearance, SpreadClearance
from impact_posture.posture.constraints.linear_joints import LinearJoints
from impact_posture.posture.constraints.pair_distances import PairDistances
from impact_posture.posture.constraints.separating_plane import ConvexBody, SeparatingPlane
from impact_posture.robot.model_joints import rigid_groups
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array

# A contact point is treated as lying in a plane if their distance is below this value, m.
_BESIDE = 0.03
# Two contacts can be at the same surface only if the cosine of the angle between their normals exceeds this value.
_PARALLEL = 0.999
# Number of tilted surfaces that replace a cone of surfaces.  In directions between the tilted surfaces, the clearance
# is up to 15 % larger.
_TILTED = 6
# If a fixed body lies behind the plane of the surface by more than this value, m, the surface must end before the
# body.
_BEHIND = 1e-3


@dataclass(frozen=True, eq=False)
class _Wall:
    """A plane or body that no link may touch except the links of the joints in ``exempt``."""

    body: ConvexBody
    exempt: frozenset[int]


class Surroundings:
    """The bodies around a robot at a given posture, and the constraints that keep the links away from these bodies.

    ``numeric`` is the model at the given posture.  ``held`` are joints that do not move.  ``clearance`` is the least
    allowed distance of all pairs, m.
    """

    def __init__(self, robot: Robot, numeric: Numeric, held: Sequence[str], clearance: float) -> None:
        self.robot, self.shapes = robot, load_shapes(robot)
        self._clearance, self._numeric, self._held = clearance, numeric, frozenset(held)
        self._bodies = [ConvexBody.of_link(hull) for hull in self.shapes.bodies]
        self._group = rigid_groups(robot.model, held)
        pairs = [SeparatingPlane(self._bodies[i], self._bodies[j], clearance) for i, j in self.shapes.pairs]
        self._pairs = [pair for pair in pairs if not self._fixed(pair)]
        self._walls: list[_Wall] = []
        self._still = {0}
        self._depths: dict[ImpactContact, float] = {}
        self.notes: list[str] = []
        if touching := self.shapes.always_touching:
            text = "shapes may touch, because they slide in each other, or touch at most postures"
            self.notes.append(f"{text}: {listed([' / '.join(pair) for pair in touching], 3)}")
        if near := [pair.name for pair in pairs if self._fixed(pair) and pair.distance(numeric)[0] < 0]:
            text = f"shapes closer than {1e3 * clearance:g} mm are not kept apart, because held joints fix them"
            self.notes.append(f"{text}: {listed(near, 3)}")

    def add_ground(self, supports: Sequence[Support], struck: Sequence[ImpactContact]) -> None:
        """Put level ground at the height of the lowest foot; the feet and the struck links may touch the ground."""
        if not supports:
            return
        feet = [point_on(self.robot, s.frame, s.offset) for s in supports]
        height = min(float(self._numeric.placement(foot).translation[2]) for foot in feet)
        self._still |= self._rigid(foot.joint for foot in feet)
        touching = [foot.joint for foot in feet] + [point_on(self.robot, c.frame).joint for c in struck]
        up = np.array([0.0, 0.0, 1.0])
        body = ConvexBody("ground", None, PointOnLink(0, height * up, np.eye(3)), normal=up)
        self._walls.append(_Wall(body, self._rigid([0, *touching])))

    def add_surface(
        self,
        contact: ImpactContact,
        width: float | None,
        feet: Sequence[PointOnLink] = (),
        contacts: Sequence[ImpactContact] = (),
    ) -> None:
        """Put the surface behind a contact: the whole plane, or a square patch of it.

        The plane passes through the contact point, unless the contact link or a link fixed to it extends behind this
        plane at the given posture.  If a link extends behind the plane, the plane is moved back to the deepest point
        of the contact link and the links fixed to it.  The contact link and the links fixed to it may touch the
        surface.  Other links may touch the surface if their own contacts lie in the plane, for example a foot next to
        the struck foot.  The links of other contacts at the same surface may also touch the surface, for example the
        other hand at a wall.  If a foot or a fixed base lies behind the plane, a patch is used instead, because the
        surface must end before this body.

        ``width`` is the edge length of the patch, m; infinite for the plane.  If ``width`` is ``None``, the plane is
        used unless a fixed body lies behind the plane.  ``feet`` are the contact points of the feet.  ``contacts``
        are the other contacts of the same impact.
        """
        point = point_on(self.robot, contact.frame, contact.offset)
        turns = contact.normal_frame == "contact"
        n = np.array(contact.normal)
        name = f"surface at {contact.frame}"
        exempt = self._rigid([point.joint])
        through = ConvexBody(name, None, point, turns, n)
        depth = max([0.0, *[-self._height(b, through) for b in self._bodies if b.point.joint in exempt]])
        self._depths[contact] = depth
        plane = replace(through, offset=-depth)
        beside = [foot for foot in feet if abs(self._above(foot, plane)) < _BESIDE]
        for other in contacts:
            # Two equal links, such as two hands, extend equally far behind their contact points, so their surfaces
            # coincide.  The contact ``other`` is therefore also tested against the plane through the contact point of
            # ``contact``.
            facing = self._world_normal(contact) @ self._world_normal(other) > _PARALLEL
            at = point_on(self.robot, other.frame, other.offset)
            if any(abs(self._above(at, face)) < _BESIDE for face in ((plane, through) if facing else (plane,))):
                beside.append(at)
        exempt |= self._rigid(at.joint for at in beside)
        behind = self._stands_behind(plane, exempt)
        if width is None and behind:
            width = PATCH
            self.notes.append(
                f"{behind} lies behind the plane of the {name}, so the surface is taken as a patch of "
                f"{width:g} m × {width:g} m (`surface`)"
            )
        if width is None or not np.isfinite(width):
            self._walls.append(_Wall(plane, exempt))
            return
        corners = _box_behind(n, width) - depth * n
        hull = SweptHull(name, name, point.joint, corners, 0.0)
        self._walls.append(_Wall(ConvexBody(name, hull, point, turns), exempt))

    def clearance_of_spread(self, tilt: float, shift: float) -> SpreadClearance | None:
        """Return the clearance to the surfaces of all contacts, each of which may be tilted and shifted.

        A point whose distance from a contact point is ``r`` along its surface has at least the distance ``clearance +
        shift + r tan(tilt)`` from this surface, to first order.  The struck links and the links that may touch the
        surface are excepted.  ``tilt`` is in degrees, and ``shift`` in m.  Surfaces that are tilted about the contact
        point in :data:`_TILTED` directions replace all tilts up to ``tilt``.  The tilt of these surfaces is slightly
        larger than ``tilt``, so that they also cover tilts in directions between them.  Return ``None`` if no contact
        has a surface, or if all links may touch the surfaces.
        """
        if not (self._depths and (tilt or shift)):
            return None
        steep = np.arctan(np.tan(np.deg2rad(tilt)) / np.cos(np.pi / _TILTED))
        struck = self._rigid(point_on(self.robot, contact.frame).joint for contact in self._depths)
        walls, pairs = {wall.body.name: wall for wall in self._walls}, list[SeparatingPlane]()
        for contact, depth in self._depths.items():
            wall, n = walls[f"surface at {contact.frame}"], np.array(contact.normal)
            links = [b for b in self._bodies if b.point.joint not in wall.exempt | struck]
            # The surface turns about the point of the surface that is nearest to the contact point.
            center, name = -depth * n, f"{wall.body.name}, tilted by {tilt:g}°"
            for heading in 2 * np.pi * np.arange(_TILTED if tilt else 1) / _TILTED:
                across = np.array([np.cos(heading), np.sin(heading)])
                tilted = cone_axes(n) @ [np.cos(steep), *(np.sin(steep) * across)]
                side, hull = replace(wall.body, name=name), wall.body.hull
                if hull is None:
                    side = replace(side, normal=tilted, offset=float(center @ tilted))
                else:
                    turn = pin.Quaternion.FromTwoVectors(n, tilted).matrix()
                    side = replace(side, hull=replace(hull, vertices=(hull.vertices - center) @ turn.T + center))
                pairs += [SeparatingPlane(link, side, self._clearance + shift) for link in links]
        frames = listed([contact.frame for contact in self._depths], 4)
        name = f"surface at {frames}, tilted by {tilt:g}°"
        text = f"links at least {1e3 * (self._clearance + shift):g} mm from the {name}"
        return SpreadClearance(name, pairs, text) if pairs else None

    def add_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Add bodies that are fixed in the world; links that cannot move may touch these bodies.

        Raise ``InputError`` if two bodies have the same name, because messages identify bodies by name.
        """
        taken = {body.name for body in self._bodies} | {wall.body.name for wall in self._walls}
        for obstacle in obstacles:
            if obstacle.name in taken:
                fault = f"'{obstacle.name}' is the name of another body"
                raise InputError(fault, where="obstacles", hint="give the obstacle another name")
            taken.add(obstacle.name)
            self._walls.append(_Wall(ConvexBody.of_link(obstacle_hull(obstacle)), self._rigid([0])))

    def depth(self, contact: ImpactContact) -> float:
        """Return how far the surface of a contact is behind the contact point, m; zero without a surface."""
        return self._depths.get(contact, 0.0)

    @cached_property
    def nested(self) -> list[LinearJoints]:
        """Constraints on pairs of links whose convex hulls overlap (:class:`JointPlanes`)."""
        planes = [planes for planes in self.shapes.joint_planes if len(planes.bounds)]
        return [LinearJoints.apart(self.robot, some) for some in planes if not {*some.joints} <= self._held]

    @cached_property
    def constraints(self) -> list[Clearance]:
        """One constraint for the distances between links, and one for each plane or body around the robot."""
        near = f"at least {1e3 * self._clearance:g} mm apart"
        groups = [("self-collision", self._pairs, f"links {near} ({len(self._pairs)} pairs)")]
        for wall in self._walls:
            apart = [b for b in self._bodies if b.point.joint not in wall.exempt]
            pairs = [SeparatingPlane(body, wall.body, self._clearance) for body in apart]
            groups.append((wall.body.name, pairs, f"links and {wall.body.name} {near}"))
        # The distances of all groups of pairs are computed together, because they are needed at the same postures.
        distances, first, constraints = PairDistances([pair for _, pairs, _ in groups for pair in pairs]), 0, []
        for name, pairs, text in groups:
            if pairs:
                indices = range(first, first + len(pairs))
                constraints.append(Clearance(name, pairs, text, distances=(distances, indices)))
                first += len(pairs)
        return constraints

    def fixed_at(self, q: Array) -> Surroundings:
        """Return a copy whose surfaces stay fixed in the world where they are at the posture ``q``, shape (nq,)."""
        fixed, numeric = copy(self), self._moving.at(q)
        fixed.__dict__.pop("constraints", None)
        fixed._walls = []
        for wall in self._walls:
            at = wall.body.placement(numeric)
            still = replace(wall.body, point=PointOnLink(0, at.translation, at.rotation), turns=True)
            fixed._walls.append(_Wall(still, wall.exempt))
        return fixed

    @property
    def by_design(self) -> str:
        """Hint that says how the user can permit links to touch."""
        tag = "<disable_collisions> in an SRDF" if self.robot.mjcf is None else "<exclude> in the MJCF"
        return f"links that touch by design may touch by {tag}"

    def closest(self, q: Array) -> dict[str, object]:
        """Return the closest bodies at ``q`` and their distance, m."""
        numeric = self._moving.at(q)
        name, value = min((c.closest(numeric) for c in self.constraints), key=lambda pair: pair[1])
        return {"closest": name, "distance": value + self._clearance}

    def to_dict(self, initial: Array, optimal: Array) -> dict[str, object]:
        """Return the ``collision`` block of ``result.json``."""
        shapes = self.shapes
        return {
            "shapes": len(shapes.bodies),
            "links_without_shapes": list(shapes.without_shapes),
            "clearance": self._clearance,
            "always_touching": [list(pair) for pair in shapes.always_touching],
            "hulls_touching": [list(pair) for pair in shapes.hulls_touching],
            "initial": self.closest(initial),
            "optimal": self.closest(optimal),
        }

    def collisions(self, q: Array) -> list[tuple[str, str]]:
        """Return the pairs of bodies (original link shapes, surface, ground, obstacles) that touch at ``q``."""
        planes, solids = self.walls_at(q)
        return self._meshes.collisions(q, solids, planes)

    @cached_property
    def _moving(self) -> Numeric:
        """A second model for evaluations at other postures, because ``_numeric`` must stay at the given posture."""
        return Numeric(self.robot.model)

    @cached_property
    def _meshes(self) -> MeshCheck:
        return MeshCheck(self.robot, self.shapes, self._group)

    def walls_at(self, q: Array) -> tuple[list[HalfSpace], list[tuple[SweptHull, pin.SE3, frozenset[int]]]]:
        """Return the planes, and the bodies with their placements, around the robot at ``q``.

        For each plane or body, the result contains the joints whose links may touch it.
        """
        numeric, planes, solids = self._moving.at(q), [], []
        for wall in self._walls:
            at = wall.body.placement(numeric)
            if wall.body.normal is not None:
                n = at.rotation @ wall.body.normal
                planes.append(HalfSpace(wall.body.name, at.translation + wall.body.offset * n, n, wall.exempt))
            elif wall.body.hull is not None:
                solids.append((wall.body.hull, at, wall.exempt))
        return planes, solids

    def _stands_behind(self, plane: ConvexBody, exempt: frozenset[int]) -> str:
        """Return the name of a fixed body behind a plane, for example a foot or the base, or an empty text."""
        still = self._still | self._rigid([0])
        for body in self._bodies:
            joint = body.point.joint
            if joint in still and joint not in exempt and self._height(body, plane) < -_BEHIND:
                return body.name
        root = PointOnLink(0, self.robot.model.jointPlacements[1].translation, np.eye(3))
        return "the base" if not self.robot.floating and self._above(root, plane) < -_BEHIND else ""

    def _fixed(self, pair: SeparatingPlane) -> bool:
        return self._group[pair.a.point.joint] == self._group[pair.b.point.joint]

    def _rigid(self, joints: Iterable[int]) -> frozenset[int]:
        """Return all joints whose links are fixed relative to the link of any joint in ``joints``."""
        groups = {self._group[joint] for joint in joints}
        return frozenset(k for k, group in enumerate(self._group) if group in groups)

    def _world_normal(self, contact: ImpactContact) -> Array:
        n = np.array(contact.normal)
        if contact.normal_frame == "world":
            return n
        return np.asarray(self._numeric.placement(point_on(self.robot, contact.frame, contact.offset)).rotation @ n)

    def _above(self, point: PointOnLink, plane: ConvexBody) -> float:
        hull = SweptHull("", "", point.joint, np.array([point.position]), 0.0)
        return self._height(ConvexBody.of_link(hull), plane)

    def _height(self, body: ConvexBody, plane: ConvexBody) -> float:
        return SeparatingPlane(body, plane, 0.0).distance(self._numeric)[0]


def _box_behind(n: Array, width: float) -> Array:
    """Return the corners, shape (8, 3), of a box behind the plane through the origin; one face lies in the plane."""
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), n).matrix()
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-2, 0)]) * width / 2
    return np.asarray(signs @ turn.T)
