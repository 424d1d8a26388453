"""Collision shapes of the robots: accuracy of the hulls, number of pairs, and time of fitting."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from docs.studies.core import Request, machine, table
from impact_posture.collision.mesh_check import MeshCheck
from impact_posture.collision.robot_shapes import RobotShapes, fit_shapes, load_shapes
from impact_posture.collision.swept_hull import separation
from impact_posture.collision.urdf_shapes import read_urdf_shapes
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import known_robots, load_robot

_HEAD = ("robot", "shapes", "hulls", "corners", "sweep, mm", "pairs of shapes", "of hulls", "fit, s",
         "at the default", "overlap by design", "nested")  # fmt: skip


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each robot."""
    yield "Corners: median number of corners of the hulls. Sweep: median and largest radius of the hulls,"
    yield "without balls and capsules. Fit: processor time, with the loading of meshes. At the default: number"
    yield "of pairs of shapes and of pairs of hulls that collide in the default posture. Nested: number of pairs"
    yield "whose contact is prevented by constraints on the joints between them, number of rows of these"
    yield "constraints, and number of pairs whose contact is not prevented."
    yield machine("pin")
    yield ""
    yield from table(_HEAD, (_row(name) for name in known_robots() if request.only in name))


def _row(name: str) -> list[str]:
    robot = load_robot(name)
    start = time.process_time()
    fit_shapes(robot, read_urdf_shapes(robot)[0])
    seconds = time.process_time() - start
    shapes = load_shapes(robot)
    fitted = [body for body in shapes.bodies if len(body.vertices) > 2]
    rows = sum(len(planes.bounds) for planes in shapes.joint_planes)
    sweeps = np.array([body.radius for body in fitted]) * 1e3

    return [
        name,
        str(len(shapes.geometry.geometryObjects)),
        str(len(shapes.bodies)),
        f"{np.median([len(body.vertices) for body in fitted]):.0f}",
        f"{np.median(sweeps):.1f}, {sweeps.max():.1f}",
        str(len(shapes.geometry.collisionPairs)),
        str(len(shapes.pairs)),
        f"{seconds:.1f}",
        f"{len(MeshCheck(robot, shapes).collisions(robot.posture()))}, {sum(_overlap(robot, shapes))}",
        _named(shapes.always_touching),
        f"{len(shapes.joint_planes)}, {rows}, {len(shapes.hulls_touching)}",
    ]


def _overlap(robot: Robot, shapes: RobotShapes) -> Iterator[bool]:
    """Return whether each pair of hulls overlaps at the default posture."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.posture())
    for a, b in ((shapes.bodies[i], shapes.bodies[j]) for i, j in shapes.pairs):
        yield separation(a, data.oMi[a.joint], b, data.oMi[b.joint]).distance < 0


def _named(pairs: Sequence[tuple[str, str]]) -> str:
    return "; ".join(f"{a}, {b}" for a, b in pairs) or "–"
