"""Collision shapes of a robot: its swept hulls, and the pairs of hulls that must not touch."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial

import coal
import numpy as np
import pinocchio as pin

from impact_posture.collision.coal_geometry import Geometry, geometry_key, load_geometry, read_shapes
from impact_posture.collision.hull_bodies import Body, merged_bodies
from impact_posture.collision.joint_planes import JointPlanes, joint_planes
from impact_posture.collision.shape_pairs import Pair, nested_pairs, pairs_of, touch_of, touching_by_design
from impact_posture.collision.swept_hull import Fit, SweptHull, fit_hull
from impact_posture.collision.urdf_shapes import LinkShape
from impact_posture.config.cached_values import StoredArray, cached
from impact_posture.errors import listed, one_line
from impact_posture.robot.robot import Robot
from impact_posture.system.progress import tell

NO_SHAPES = "the robot has no shapes, so nothing keeps its links apart; joint origins are checked at the end"


@dataclass(frozen=True, eq=False)
class FittedShapes:
    """Collision shapes of a robot in the form that the cache stores.

    Attributes:
        bodies: Swept hulls that contain all shapes.
        pairs: Pairs of bodies that must not touch, as indices into ``bodies``, shape (k, 2).
        always_touching: Names of shapes that overlap by design (:func:`touching_by_design`), so they may touch.
        joint_planes: Bounds on joints for nested bodies (:func:`nested_pairs`), which ``pairs`` leaves out.
        hulls_touching: Names of nested bodies without ``joint_planes``.  Only :class:`MeshCheck` detects collisions
            of these bodies.
        links: Links whose shapes are used.
        warnings: Warnings about shapes, one line each.
    """

    bodies: tuple[SweptHull, ...]
    pairs: StoredArray
    always_touching: tuple[tuple[str, str], ...]
    joint_planes: tuple[JointPlanes, ...]
    hulls_touching: tuple[tuple[str, str], ...]
    links: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RobotShapes(FittedShapes):
    """Collision shapes and their robot; the shapes of the URDF are loaded on demand.

    ``without_shapes`` contains the names of links for which the URDF describes only unusable shapes.  If a joint
    moves a mass but no shape, its first link is also included.
    """

    robot: Robot
    without_shapes: tuple[str, ...]

    @cached_property
    def geometry(self) -> pin.GeometryModel:
        """The shapes of the URDF, with the pairs that must not touch."""
        loaded = load_geometry(self.robot, read_shapes(self.robot).shapes)
        names = [shape.name for shape in loaded.model.geometryObjects]
        touching = set(self.always_touching)
        for i, j in pairs_of(loaded.apart):
            if (names[i], names[j]) not in touching:
                loaded.model.addCollisionPair(pin.CollisionPair(i, j))
        return loaded.model


@dataclass(frozen=True)
class _Source:
    """Argument of :func:`_shapes`.  Sources with equal keys and warnings have equal shapes.

    ``links`` are the links for which the URDF describes shapes.
    """

    key: str
    robot: Robot = field(compare=False)
    described: list[LinkShape] = field(compare=False)
    warnings: tuple[str, ...]
    links: tuple[str, ...]

    def without_shapes(self, used: Collection[str]) -> tuple[str, ...]:
        model, bare = self.robot.model, list[str]()
        frames = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
        covered = {0, *(int(frame.parentJoint) for frame in frames if frame.name in used)}
        for frame in frames:
            joint = int(frame.parentJoint)
            alone = joint not in covered and model.inertias[joint].mass > 0
            if frame.name not in used and (frame.name in self.links or alone):
                bare.append(str(frame.name))
                covered.add(joint)
        return tuple(bare)

    def all_warnings(self, used: Collection[str], warnings: Iterable[str]) -> tuple[str, ...]:
        words, bare = [] if used else [NO_SHAPES], self.without_shapes(used)
        if used and bare:
            named = f"links without shapes: {listed(bare)}"
            words = [one_line(f"{named}; nothing keeps them from a collision, and only their origins are checked")]
        return (*self.warnings, *warnings, *words)


def _source(robot: Robot) -> _Source:
    read = read_shapes(robot)
    key = geometry_key(robot, read.shapes)
    return _Source(key, robot, read.shapes, tuple(read.warnings), tuple(read.described))


def shape_warnings(robot: Robot) -> tuple[str, ...]:
    """Return the warnings of :func:`load_shapes`, but do not compute hulls, because this would take longer.

    Raises:
        UrdfError: The same errors as in :func:`load_shapes`.
    """
    source = _source(robot)

    def load() -> tuple[tuple[str, ...], ...]:
        tell("reading collision shapes")
        geometry = load_geometry(robot, source.described)
        return tuple(dict.fromkeys(geometry.links)), geometry.warnings

    links, warnings = cached("loaded-shapes", source.key, tuple[tuple[str, ...], ...], load)
    return source.all_warnings(links, warnings)


@lru_cache(maxsize=16)
def load_shapes(robot: Robot) -> RobotShapes:
    """Return the collision shapes of a robot from its URDF; links without collision shapes use their visual shapes.

    The result is cached in memory and on disk; the key is a hash of the URDF and its meshes.
    """
    return _shapes(_source(robot))


@lru_cache(maxsize=16)
def _shapes(source: _Source) -> RobotShapes:
    fitted = cached("shapes", source.key, FittedShapes, lambda: fit_shapes(source.robot, source.described))
    warnings, bare = source.all_warnings(fitted.links, fitted.warnings), source.without_shapes(fitted.links)
    return RobotShapes(**vars(fitted) | {"warnings": warnings}, robot=source.robot, without_shapes=bare)


def fit_shapes(robot: Robot, described: list[LinkShape]) -> FittedShapes:
    """Load shapes, fit hulls, and determine the pairs that must not touch and the bounds for nested bodies."""
    tell("fitting collision shapes")
    loaded = load_geometry(robot, described)
    shapes, apart = loaded.model.geometryObjects, loaded.apart
    touching = touching_by_design(robot, shapes, pairs_of(apart))
    for i, j in touching:
        apart[i, j] = apart[j, i] = False
    merged = merged_bodies(shapes, apart)
    hulls = [_fitted(body, loaded) for body in merged]
    # All shapes of a merged body must stay apart from the same shapes.
    first = [body.shapes[0] for body in merged]
    pairs = pairs_of(apart[np.ix_(first, first)])
    touch = touch_of(shapes)

    def bodies_touch(pair: Pair, data: pin.Data) -> bool:
        a, b = (merged[k].shapes for k in pair)
        return any(touch((i, j), data) for i in a for j in b)

    nested = nested_pairs(robot, hulls, pairs, bodies_touch)
    planes: dict[tuple[str, str], JointPlanes | None] = {}
    for pair in nested:
        a, b = (hulls[k] for k in pair)
        names = (a.name, b.name)
        planes[names] = joint_planes(robot, names, (a.joint, b.joint), partial(bodies_touch, pair))
    return FittedShapes(
        bodies=tuple(replace(hull, known_faces=hull.faces) for hull in hulls),
        pairs=np.array([pair for pair in pairs if pair not in nested], dtype=int).reshape(-1, 2),
        always_touching=tuple((shapes[i].name, shapes[j].name) for i, j in touching),
        hulls_touching=tuple(names for names, bounds in planes.items() if bounds is None),
        joint_planes=tuple(bounds for bounds in planes.values() if bounds is not None),
        links=tuple(dict.fromkeys(loaded.links)),
        warnings=loaded.warnings,
    )


def _fitted(body: Body, loaded: Geometry) -> SweptHull:
    """Fit the hull of a body; the hull of a single ball or capsule is exact."""
    shape = loaded.model.geometryObjects[body.shapes[0]]
    alone, solid, at = len(body.shapes) == 1, shape.geometry, shape.placement
    if alone and isinstance(solid, coal.Sphere):
        fit = Fit(np.array([at.translation]), float(solid.radius))
    elif alone and isinstance(solid, coal.Capsule):
        ends = [at.act(np.array([0.0, 0.0, side * solid.halfLength])) for side in (-1, 1)]
        fit = Fit(np.array(ends), float(solid.radius))
    else:
        fit = fit_hull(np.vstack(body.corners))
    link = loaded.links[body.shapes[0]]
    return SweptHull(shape.name, link, int(shape.parentJoint), fit.vertices, fit.radius)
