"""A robot and its surroundings as one MuJoCo model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.mjcf import Mjcf, write_mjcf
from impact_posture.dynamics.mjcf_scene import Additions
from impact_posture.dynamics.mjcf_text import numbers
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import InputError, UnsupportedJoint
from impact_posture.escape import xml_name
from impact_posture.impact.contact import point_on
from impact_posture.robot.actuation import actuation_matrix
from impact_posture.robot.robot import Robot
from impact_posture.simulation.scene import Scene, Shape, Surface

Array = NDArray[np.float64]

# Families whose velocities are the same numbers, in the same axes, in Pinocchio and MuJoCo.
_DRIVEN = ("revolute", "continuous", "prismatic", "translation", "spherical")


@dataclass(frozen=True, eq=False)
class BuiltScene:
    """A scene's model before MuJoCo has compiled it.

    Attributes:
        mjcf: The model.  Its actuators: rotors (control: thrust, N), then joints (N·m or N), in the order of ``u``.
        normals: Unit normal of each surface, by name.
        points: A point on each surface, world, meters, by name.
        gaps: Distance of each shape from each surface in the start posture, m, by surface and shape.
        shape_geoms: Name of each shape's geom, in the scene's order.
    """

    mjcf: Mjcf
    normals: Mapping[str, Array]
    points: Mapping[str, Array]
    gaps: Mapping[tuple[str, str], float]
    shape_geoms: tuple[str, ...]


def build_scene(robot: Robot, scene: Scene, q: Array) -> BuiltScene:
    """Put a robot into its surroundings.

    Args:
        robot: The robot.
        scene: Its surroundings.
        q: Start posture, shape (nq,): gaps and the shapes' default centers are taken there.

    Raises:
        FrameNotFound: Of a shape.
        ContactError: A shape on a frame that is welded to the world.
        InputError: A shape without a center where there is no surface, or a surface with a gap to no shape.
        UnsupportedJoint: A joint that no motor drives.
    """
    numeric = Numeric(robot.model).at(q)
    written = write_mjcf(robot.model, robot.name)
    added = Additions(written)
    physics = scene.physics
    added.option(timestep=repr(float(physics.timestep)), integrator="implicitfast", cone="elliptic")
    # A diverging simulation must not go on from its start in silence.
    added.flag(autoreset="disable")
    if physics.gravity is not None:
        added.option(gravity=numbers(physics.gravity))
    added.stops(solreflimit=numbers(physics.stop_solref), solimplimit=numbers(physics.stop_solimp))

    normals = {s.name: np.array(s.normal, dtype=float) / np.linalg.norm(s.normal) for s in scene.surfaces}
    first = next(iter(normals.values()), None)
    geoms, placed = [], []
    for shape in scene.shapes:
        place = _placement(robot, numeric, shape, first)
        joint = point_on(robot, shape.frame).joint
        geoms.append(xml_name(f"shape {shape.frame}"))
        added.shape(joint, geoms[-1], shape.kind, shape.size, place)
        placed.append((shape, numeric.data.oMi[joint] * place))
    points = {s.name: _point(s, normals[s.name], placed) for s in scene.surfaces}
    gaps = {
        (name, shape.frame): float(normals[name] @ (_lowest(shape, place, normals[name]) - point))
        for name, point in points.items()
        for shape, place in placed
    }
    for surface in scene.surfaces:
        name, law = xml_name(f"surface {surface.name}"), surface.law
        added.plane(name, points[surface.name], normals[surface.name])
        for geom in geoms:
            added.pair(
                name,
                geom,
                condim="3" if law.friction else "1",
                friction=numbers((law.friction, law.friction, 0.0, 0.0, 0.0)),
                solref=numbers(law.solref),
                solimp=numbers(law.solimp),
            )
    _add_rotors(added, robot)
    _add_motors(added, robot, written.joints)
    return BuiltScene(added.model(), normals, points, gaps, tuple(geoms))


def _placement(robot: Robot, numeric: Numeric, shape: Shape, normal: Array | None) -> pin.SE3:
    """A shape's pose in its joint's frame."""
    point = point_on(robot, shape.frame)
    frame = pin.SE3(point.rotation, point.position)
    if shape.center is not None:
        return frame * pin.SE3(np.eye(3), np.array(shape.center, dtype=float))
    if normal is None:
        raise InputError("has no center and no surface to be put against", where=f"shape at '{shape.frame}'",
                         hint="give a center")  # fmt: skip
    up = (numeric.data.oMi[point.joint] * frame).rotation.T @ normal
    if shape.kind == "sphere":
        rise = shape.size[0] * up
    else:
        axis = int(np.argmax(np.abs(up)))
        rise = np.sign(up[axis]) * shape.size[axis] * np.eye(3)[axis]
    return frame * pin.SE3(np.eye(3), np.array(shape.offset, dtype=float) + rise)


def _point(surface: Surface, normal: Array, placed: list[tuple[Shape, pin.SE3]]) -> Array:
    """A point on a surface: given, or below the nearest shape."""
    if surface.point is not None:
        return np.array(surface.point, dtype=float)
    if not placed:
        raise InputError("there is no shape that it has a gap to", where=f"surface '{surface.name}'",
                         hint="give a point, or a shape")  # fmt: skip
    lowest = min((_lowest(shape, place, normal) for shape, place in placed), key=lambda p: float(normal @ p))
    return np.asarray(lowest - surface.gap * normal)


def _lowest(shape: Shape, place: pin.SE3, normal: Array) -> Array:
    """Below a shape's center, on its lowest plane along a normal."""
    reach = shape.size[0]
    if shape.kind == "box":
        reach = float(np.abs(place.rotation.T @ normal) @ np.array(shape.size))
    return np.asarray(place.translation - reach * normal)


def _add_rotors(added: Additions, robot: Robot) -> None:
    """One motor a rotor: its control is the thrust, its wrench acts at the base."""
    propulsion = robot.spec.propulsion
    if propulsion is None:
        return
    wrenches = actuation_matrix(robot.model, propulsion)[:6, : len(propulsion.rotors)]
    added.site(1, "base of the rotors", pin.SE3.Identity())
    for rotor, wrench in zip(propulsion.rotors, wrenches.T, strict=True):
        added.motor(xml_name(f"rotor {rotor.name}"), wrench, site="base of the rotors")


def _add_motors(added: Additions, robot: Robot, joints: Mapping[int, tuple[str, ...]]) -> None:
    """One motor an entry of ν behind the base."""
    for slot in Chart(robot.model).slots[1 if robot.floating else 0 :]:
        if slot.kind.family not in _DRIVEN:
            raise UnsupportedJoint(
                f"no motor drives joint '{slot.name}' ({slot.kind.family})",
                where="simulation",
                hint="lock it (--lock), or model it as slides and hinges",
            )
        if slot.kind.family == "spherical":
            for k, axis in enumerate(np.eye(3)):
                added.motor(xml_name(f"motor {slot.name}[{k}]"), axis, joint=joints[slot.index][0])
            continue
        for name in joints[slot.index]:
            added.motor(f"motor {name}", (1.0,), joint=name)
