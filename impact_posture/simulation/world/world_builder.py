"""MuJoCo model of a robot and its surroundings."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import pinocchio as pin

from impact_posture.collision.coal_geometry import read_shapes
from impact_posture.collision.contact_front import rigid_silhouettes
from impact_posture.collision.mesh_file import UnusableShape
from impact_posture.collision.shape_corners import shape_points
from impact_posture.collision.urdf_shapes import largest_extent
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.mjcf import WORLD, Mjcf, build_mjcf
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, UnsupportedJoint
from impact_posture.impact.impact_contact import point_on
from impact_posture.robot.actuation import actuation_matrix
from impact_posture.robot.model_joints import joint_range
from impact_posture.robot.robot import Robot
from impact_posture.simulation.world.contact_law import SOLIMP_SHAPE, ContactLaw
from impact_posture.simulation.world.mjcf_contacts import LinkGeom, add_link_geoms
from impact_posture.simulation.world.scene import Physics, Scene, Shape, Surface
from impact_posture.simulation.world.throw import BALL, Throw, add_ball
from impact_posture.system.arrays import Array
from impact_posture.system.escape import xml_name
from impact_posture.system.optional_package import import_mujoco

# Joint families whose velocities have the same meaning in Pinocchio and MuJoCo.
_DRIVEN = ("revolute", "continuous", "prismatic", "translation", "spherical")
# Function from a unit normal to the point of a shape that is lowest along this normal, world, m.
_Lowest = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class BuiltScene:
    """Model of a scene before MuJoCo compiles it.

    Attributes:
        mjcf: The MuJoCo model.  The actuators have the order of ``u``: first the rotors (thrust, N), then the joints
            (N·m or N).
        normals: Unit normal of each surface, by name.
        points: Point on each surface, world, m, by name.
        gaps: Pair (surface, shape) → distance of the shape from the surface in the start posture, m.
        shape_geoms: Names of the geoms of each shape, in the order of the shapes in the scene.
        rotor_link: Points whose hull contains the link with the rotors, in the frame of its joint, shape (k, 3), m;
            empty without rotors.
        link_geoms: Name of each geom from the MJCF of the robot → its link.
        throw: Throw of the ball; ``None`` if the scene has no ball.
    """

    mjcf: Mjcf
    normals: Mapping[str, Array]
    points: Mapping[str, Array]
    gaps: Mapping[tuple[str, str], float]
    shape_geoms: tuple[tuple[str, ...], ...]
    rotor_link: Array
    link_geoms: Mapping[str, LinkGeom]
    throw: Throw | None = None


def build_scene(robot: Robot, scene: Scene, q: Array, throw: Throw | None = None) -> BuiltScene:
    """Build the model of a robot in its surroundings.

    The gaps of surfaces and the default centers of shapes are computed at the posture ``q``.

    Raises:
        FrameNotFound: The frame of a shape does not exist.
        ContactError: The frame of a shape is welded to the world.
        InputError: MuJoCo is not installed, a shape without a center has no surface to determine the center, a
            surface without a point has no shape to determine the point, or a link has no solid geoms.
        UnsupportedJoint: The robot has a joint that no MuJoCo motor can drive.
    """
    numeric = Numeric(robot.model).at(q)
    mjcf = build_mjcf(robot.model, robot.name)
    _set_physics(mjcf.spec, scene.physics)
    _set_passive(mjcf, robot)
    mjcf.couple_joints(robot)
    normals = {s.name: np.array(s.normal, dtype=float) / np.linalg.norm(s.normal) for s in scene.surfaces}
    links = add_link_geoms(mjcf, robot)
    geoms, lowest = list[tuple[str, ...]](), dict[str, _Lowest]()
    for shape in scene.shapes:
        faced, joint, name = scene.faced(shape), point_on(robot, shape.frame).joint, xml_name(f"shape {shape.frame}")
        if shape.kind == "link":
            geoms.append(_add_link(mjcf, links, joint, name))
            lowest[shape.frame] = partial(_lowest_of_link, robot, joint, numeric.data.oMi[joint])
        else:
            placement = _placement(robot, numeric, shape, None if faced is None else normals[faced.name])
            geoms.append((name,))
            mjcf.add_geom(joint, name, shape.kind, shape.size, placement)
            lowest[shape.frame] = partial(_lowest, shape, numeric.data.oMi[joint] * placement)
    points = {s.name: _point(s, normals[s.name], lowest.values()) for s in scene.surfaces}
    gaps = {
        (name, frame): float(normals[name] @ (lowest_point(normals[name]) - point))
        for name, point in points.items()
        for frame, lowest_point in lowest.items()
    }
    hulls, rotor_link = _add_rotor_link(mjcf, robot)
    if robot.floating:
        # A link with a shape of the scenario touches surfaces only with this shape.  Links of a robot with a fixed
        # base do not touch surfaces, because a surface may cut the base.
        shaped = {WORLD, *(point_on(robot, shape.frame).joint for shape in scene.shapes)}
        hulls += [geom for geom, link in links.items() if link.joint not in shaped]
    for surface in scene.surfaces:
        name = xml_name(f"surface {surface.name}")
        mjcf.add_plane(name, points[surface.name], normals[surface.name])
        for geom in (*chain(*geoms), *hulls):
            _add_pair(mjcf, name, geom, surface)
    if throw is not None:
        add_ball(mjcf, throw)
        _add_pair(mjcf, BALL, xml_name(f"shape {throw.frame}"), throw)
    _add_rotors(mjcf, robot)
    _add_motors(mjcf, robot)
    return BuiltScene(mjcf, normals, points, gaps, tuple(geoms), rotor_link, links, throw)


def _add_link(mjcf: Mjcf, links: Mapping[str, LinkGeom], joint: int, name: str) -> tuple[str, ...]:
    """Copy the solid geoms of a link, so that the copies touch only surfaces, and return the names of the copies."""
    names = []
    for geom in (mjcf.spec.geom(geom) for geom, link in links.items() if link.joint == joint):
        names.append(f"{name} ({geom.name})")
        geom.parent.add_geom(
            name=names[-1], type=geom.type, size=geom.size, meshname=geom.meshname,
            pos=geom.pos, quat=geom.quat, mass=0.0, contype=0, conaffinity=0,
        )  # fmt: skip
    if not names:
        hint = "give the shape the kind sphere or box, or take an MJCF in which geoms of the link collide"
        raise InputError("its link has no solid geoms", where=name, hint=hint)
    return tuple(names)


def _add_rotor_link(mjcf: Mjcf, robot: Robot) -> tuple[list[str], Array]:
    """Add the hulls of the link that carries the rotors, with their disks.

    Return the names of the geoms, and the points of :attr:`BuiltScene.rotor_link`.  Surfaces are planes, so a shape
    and its hull touch a surface at the same points.
    """
    propulsion, names, points = robot.spec.propulsion, [], [np.zeros((0, 3))]
    shapes = [] if propulsion is None else read_shapes(robot)[0]
    for shape in (shape for shape in shapes if propulsion is not None and shape.link == propulsion.frame):
        # Skip unusable shapes, which the warnings of the robot already name.
        with suppress(UnusableShape):
            corners = shape_points(shape.load(largest_extent(robot)).mesh)
            link = robot.model.frames[robot.frame_id(shape.link)]
            placement = link.placement * shape.placement
            names.append(xml_name(f"rotor link {shape.name}"))
            points.append(corners @ placement.rotation.T + placement.translation)
            mjcf.add_hull(link.parentJoint, names[-1], points[-1])
    return names, np.vstack(points)


def _add_pair(mjcf: Mjcf, first: str, second: str, law: ContactLaw) -> None:
    mjcf.spec.add_pair(
        geomname1=first,
        geomname2=second,
        condim=3 if law.friction else 1,
        friction=(law.friction, law.friction, 0.0, 0.0, 0.0),
        solref=law.solref,
        solimp=(*law.solimp, *SOLIMP_SHAPE),
    )


def _set_physics(spec: Any, physics: Physics) -> None:
    mujoco = import_mujoco()
    spec.option.timestep = physics.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # By default, MuJoCo silently resets a simulation that diverges.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if physics.gravity is not None:
        spec.option.gravity = physics.gravity
    for joint in spec.joints:
        joint.solref_limit, joint.solimp_limit = physics.stop_solref, (*physics.stop_solimp, *SOLIMP_SHAPE)


def _set_passive(mjcf: Mjcf, robot: Robot) -> None:
    """Give the joints the damping, friction loss and springs of the MJCF from which the robot was loaded."""
    if robot.mjcf is None:
        return
    source = robot.mjcf.model
    damping, damping_poly, friction, stiffness, stiffness_poly, rest = robot.mjcf.passive
    for index in joint_range(robot.model):
        j = robot.mjcf.joints.getJointId(robot.model.names[index]) - 1
        dof, joint = source.jnt_dofadr[j], mjcf.spec.joint(mjcf.joints[index][0])
        joint.damping = np.r_[damping[dof], damping_poly[dof]]
        joint.frictionloss = friction[dof]
        joint.stiffness = np.r_[stiffness[j], stiffness_poly[j]]
        joint.springref = rest[source.jnt_qposadr[j]]


def _placement(robot: Robot, numeric: Numeric, shape: Shape, normal: Array | None) -> pin.SE3:
    point = point_on(robot, shape.frame)
    frame = pin.SE3(point.rotation, point.position)
    if shape.center is not None:
        return frame * pin.SE3(np.eye(3), np.array(shape.center, dtype=float))
    if normal is None:
        what = "has no center, and no surface determines its center"
        raise InputError(what, where=f"shape at '{shape.frame}'", hint="give a center")
    up = (numeric.data.oMi[point.joint] * frame).rotation.T @ normal
    if shape.kind == "sphere":
        rise = shape.size[0] * up
    else:
        axis = int(np.argmax(np.abs(up)))
        rise = np.sign(up[axis]) * shape.size[axis] * np.eye(3)[axis]
    return frame * pin.SE3(np.eye(3), np.array(shape.offset, dtype=float) + rise)


def _point(surface: Surface, normal: Array, lowest: Collection[_Lowest]) -> Array:
    """Return a point of a surface.  By default, the surface is at the distance ``gap`` from the nearest shape."""
    if surface.point is not None:
        return np.array(surface.point, dtype=float)
    if not lowest:
        what = "has neither a point nor a shape that determines the point"
        raise InputError(what, where=f"surface '{surface.name}'", hint="give a point, or a shape")
    nearest = min((point(normal) for point in lowest), key=lambda point: float(normal @ point))
    return np.asarray(nearest - surface.gap * normal)


def _lowest(shape: Shape, placement: pin.SE3, normal: Array) -> Array:
    """Return the point below the center of a shape (against the normal) at the height of the lowest point."""
    reach = shape.size[0]
    if shape.kind == "box":
        reach = float(np.abs(placement.rotation.T @ normal) @ np.array(shape.size))
    return np.asarray(placement.translation - reach * normal)


def _lowest_of_link(robot: Robot, joint: int, placement: pin.SE3, normal: Array) -> Array:
    """Return the lowest point (against the normal) of the shapes that a joint moves."""
    down = -placement.rotation.T @ normal
    shapes = [shape for shape in rigid_silhouettes(robot, joint) if shape.joint == joint]
    if not shapes:
        what = f"the shapes that '{robot.model.names[joint]}' moves cannot be used"
        raise InputError(what, where=robot.name, hint="see the warnings of `inspect`, or use a sphere or a box")
    points = np.vstack([shape.foremost(down) for shape in shapes])
    return np.asarray(placement.act(points[(points @ down).argmax()]))


def _add_rotors(mjcf: Mjcf, robot: Robot) -> None:
    """Add a MuJoCo motor for each rotor.  The control of the motor is the thrust, and its wrench acts on the base."""
    propulsion = robot.spec.propulsion
    if propulsion is None:
        return
    wrenches = actuation_matrix(robot.model, propulsion)[:6, : len(propulsion.rotors)]
    site, transmission = "base of the rotors", import_mujoco().mjtTrn.mjTRN_SITE
    mjcf.body(1).add_site(name=site)
    for rotor, wrench in zip(propulsion.rotors, wrenches.T, strict=True):
        name = xml_name(f"rotor {rotor.name}")
        mjcf.spec.add_actuator(name=name, gear=wrench, target=site, trntype=transmission)


def _add_motors(mjcf: Mjcf, robot: Robot) -> None:
    transmission = import_mujoco().mjtTrn.mjTRN_JOINT
    for slot in Chart(robot.model).slots[1 if robot.floating else 0 :]:
        if slot.kind.family not in _DRIVEN:
            what = f"no motor drives joint '{slot.name}' ({slot.kind.family})"
            raise UnsupportedJoint(
                what,
                where="simulation",
                hint="lock the joint (`lock`), or replace it by revolute and prismatic joints",
            )
        targets = mjcf.joints[slot.index]
        motors = [(f"motor {name}", name, np.eye(3)[0]) for name in targets]
        if slot.kind.family == "spherical":
            motors = [(xml_name(f"motor {slot.name}[{k}]"), targets[0], axis) for k, axis in enumerate(np.eye(3))]
        for name, target, axis in motors:
            gear = (*axis, 0.0, 0.0, 0.0)
            mjcf.spec.add_actuator(name=name, gear=gear, target=target, trntype=transmission)
