"""The MJCF of a robot in one posture, a plane below its contact point, its feet tied to where they are."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.mjcf import Mjcf
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import PointOnLink
from impact_posture.impact.contact import point_on
from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]

# Radius of the ball at the contact point, meters: any will do, since the ball touches at the point itself.
BALL = 0.01
# Height of the contact point above the plane, meters: all postures meet it in the same part of a step.
_GAP = 1e-6
# The stiffest constraint that MuJoCo takes, at any depth.
_SOLIMP = "0.9999 0.9999 0.001"

_OPTION = {
    "gravity": "0 0 0", "integrator": "Euler", "cone": "elliptic", "solver": "Newton",
    "tolerance": "0", "iterations": "200", "ls_iterations": "100", "ls_tolerance": "1e-6",
}  # fmt: skip


def with_surface(written: Mjcf, objective: ImpactObjective, q: Vector) -> Mjcf:
    """Add a ball at the contact point, the plane, and a tie for each support.

    Args:
        written: The robot.
        objective: Contact and supports.
        q: The posture that they are placed for, shape (nq,).
    """
    robot, oracle = objective.robot, objective.oracle.at(q)
    numeric, n = Numeric(robot.model).at(q), oracle.n.copy()
    root = ET.fromstring(written.xml)
    option, world = root.find("option"), root.find("worldbody")
    assert option is not None and world is not None
    option.attrib |= _OPTION
    ET.SubElement(option, "flag", limit="disable")
    bodies = {b.get("name"): b for b in root.iter("body")}

    contact = point_on(robot, objective.contact.frame, objective.contact.offset)
    position = numeric.placement(contact).translation
    # The ball's lowest point is the contact point.
    center = numeric.data.oMi[contact.joint].actInv(position + BALL * n)
    ball = {"name": "ball", "type": "sphere", "size": repr(BALL), "pos": _text(center)}
    ET.SubElement(bodies[written.bodies[contact.joint]], "geom", ball)
    upright = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), n).matrix()
    plane = {"name": "surface", "type": "plane", "size": "1 1 1"}
    ET.SubElement(world, "geom", {**plane, **_pose(pin.SE3(upright, position - _GAP * n))})
    pair = {"geom1": "surface", "geom2": "ball", "solimp": _SOLIMP, "condim": "1"}
    ET.SubElement(ET.SubElement(root, "contact"), "pair", pair)

    equality = ET.SubElement(root, "equality")
    for k, support in enumerate(objective.supports):
        foot: PointOnLink = point_on(robot, support.frame, support.offset)
        place = pin.SE3(foot.rotation, foot.position)
        ET.SubElement(bodies[written.bodies[foot.joint]], "site", {"name": f"tie_{k}", **_pose(place)})
        ET.SubElement(world, "site", {"name": f"ground_{k}", **_pose(numeric.placement(foot))})
        kind = "connect" if support.kind == "point" else "weld"
        ET.SubElement(equality, kind, {"site1": f"tie_{k}", "site2": f"ground_{k}", "solimp": _SOLIMP})
    return replace(written, xml=ET.tostring(root, encoding="unicode"))


def _pose(place: pin.SE3) -> dict[str, str]:
    x, y, z, w = pin.Quaternion(np.array(place.rotation)).coeffs()
    return {"pos": _text(place.translation), "quat": _text(np.array([w, x, y, z]))}


def _text(values: Vector) -> str:
    return " ".join(repr(float(v)) for v in values)
