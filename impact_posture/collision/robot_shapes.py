"""The collision shapes of a robot: its swept hulls, and which of them have to keep apart."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial

import coal
import numpy as np
import pinocchio as pin

from impact_posture.collision.coal_geometry import Geometry, geometry_key, load_geometry
from impact_posture.collision.hull_bodies import Body, merged_bodies
from impact_posture.collision.joint_planes import JointPlanes, joint_planes
from impact_posture.collision.shape_pairs import Pair, hindered, mostly_touching, pairs_of, touch_of
from impact_posture.collision.swept_hull import Fit, SweptHull, fit_hull
from impact_posture.collision.urdf_shapes import UrdfShape, read_urdf_shapes
from impact_posture.config.cached_values import StoredArray, read_stored, write_stored
from impact_posture.robot.robot import Robot
from impact_posture.system.progress import tell

NO_SHAPES = "the robot has no shapes, so nothing keeps its links apart; joint origins are checked at the end"


@dataclass(frozen=True, eq=False)
class FittedShapes:
    """The collision shapes of a robot, as they are stored.

    Attributes:
        bodies: Swept hulls that hold all shapes.
        pairs: Bodies that have to keep apart, as indices into ``bodies``, shape (k, 2).
        always_touching: Names of shapes that touch at the default posture and at most others, so that they overlap by
            design and need not keep apart.
        joint_planes: What keeps bodies apart whose hulls touch at most of the postures at which their shapes do not.
            They are in no pair.  Where their shapes touch nowhere, it has no rows.
        hulls_touching: Names of such bodies for which no planes are found.  Only the check on the shapes finds their
            collisions.
        warnings: Shapes that are left out, and what a robot without shapes means; one line each.
    """

    bodies: tuple[SweptHull, ...]
    pairs: StoredArray
    always_touching: tuple[tuple[str, str], ...]
    joint_planes: tuple[JointPlanes, ...]
    hulls_touching: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RobotShapes(FittedShapes):
    """The same, with the robot, for the shapes themselves."""

    robot: Robot

    @cached_property
    def geometry(self) -> pin.GeometryModel:
        """The shapes themselves, with the pairs that have to keep apart."""
        loaded = load_geometry(self.robot, read_urdf_shapes(self.robot)[0])
        names = [shape.name for shape in loaded.model.geometryObjects]
        touching = set(self.always_touching)
        for i, j in pairs_of(loaded.apart):
            if (names[i], names[j]) not in touching:
                loaded.model.addCollisionPair(pin.CollisionPair(i, j))
        return loaded.model


@dataclass(frozen=True)
class _Source:
    """What shapes are made of; equal keys and warnings make equal shapes."""

    key: str
    robot: Robot = field(compare=False)
    described: list[UrdfShape] = field(compare=False)
    warnings: tuple[str, ...]


@lru_cache(maxsize=16)
def load_shapes(robot: Robot) -> RobotShapes:
    """Return the collision shapes of a robot from its URDF, with the visual ones of links that have no others.

    The fit is kept in memory, and in the cache of the user by the content of the URDF and its meshes.
    """
    described, warnings = read_urdf_shapes(robot)
    return _shapes(_Source(geometry_key(robot, described), robot, described, tuple(warnings)))


@lru_cache(maxsize=16)
def _shapes(source: _Source) -> RobotShapes:
    found = read_stored("shapes", source.key, FittedShapes)
    if found is None:
        found = fit_shapes(source.robot, source.described)
        write_stored("shapes", source.key, found)
    warnings = (*source.warnings, *found.warnings, *(() if found.bodies else (NO_SHAPES,)))
    return RobotShapes(**vars(found) | {"warnings": warnings}, robot=source.robot)


def fit_shapes(robot: Robot, described: list[UrdfShape]) -> FittedShapes:
    """Load the shapes, fit their hulls, and find the pairs; bodies in each other's hollows get bounds on joints."""
    tell("fitting collision shapes")
    loaded = load_geometry(robot, described)
    shapes, apart = loaded.model.geometryObjects, loaded.apart
    touching = mostly_touching(robot, shapes, pairs_of(apart))
    for i, j in touching:
        apart[i, j] = apart[j, i] = False
    merged = merged_bodies(shapes, apart)
    hulls = [_fitted(body, loaded) for body in merged]
    # The shapes of a body have to keep apart from the same shapes.
    first = [body.shapes[0] for body in merged]
    pairs = pairs_of(apart[np.ix_(first, first)])
    touch = touch_of(shapes)

    def bodies_touch(pair: Pair, data: pin.Data) -> bool:
        a, b = (merged[k].shapes for k in pair)
        return any(touch((i, j), data) for i in a for j in b)

    nested = hindered(robot, hulls, pairs, bodies_touch)
    named = {pair: (hulls[pair[0]].name, hulls[pair[1]].name) for pair in nested}
    planes = {
        pair: joint_planes(robot, names, (hulls[pair[0]].joint, hulls[pair[1]].joint), partial(bodies_touch, pair))
        for pair, names in named.items()
    }
    return FittedShapes(
        bodies=tuple(replace(hull, known_faces=hull.faces) for hull in hulls),
        pairs=np.array([pair for pair in pairs if pair not in named], dtype=int).reshape(-1, 2),
        always_touching=tuple((shapes[i].name, shapes[j].name) for i, j in touching),
        hulls_touching=tuple(names for pair, names in named.items() if planes[pair] is None),
        joint_planes=tuple(one for one in planes.values() if one is not None),
        warnings=loaded.warnings,
    )


def _fitted(body: Body, loaded: Geometry) -> SweptHull:
    """Fit the hull of a body; that of a single ball or capsule is exact."""
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
