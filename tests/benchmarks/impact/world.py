"""The MJCF of a robot in one posture, a plane below its contact point, its feet tied to where they are."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.mjcf import Mjcf
from impact_posture.dynamics.mjcf_scene import WORLD, Additions
from impact_posture.dynamics.numeric import Numeric
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
        objective: ImpactContact and supports.
        q: The posture that they are placed for, shape (nq,).
    """
    robot, oracle = objective.robot, objective.oracle.at(q)
    numeric, n = Numeric(robot.model).at(q), oracle.n.copy()
    added = Additions(written)
    added.option(**_OPTION)
    added.flag(limit="disable")

    contact = point_on(robot, objective.contact.frame, objective.contact.offset)
    position = numeric.placement(contact).translation
    # The ball's lowest point is the contact point.
    center = numeric.data.oMi[contact.joint].actInv(position + BALL * n)
    added.shape(contact.joint, "ball", "sphere", (BALL,), pin.SE3(np.eye(3), center))
    added.plane("surface", position - _GAP * n, n)
    added.pair("surface", "ball", solimp=_SOLIMP, condim="1")

    for k, support in enumerate(objective.supports):
        foot = point_on(robot, support.frame, support.offset)
        added.site(foot.joint, f"tie_{k}", pin.SE3(foot.rotation, foot.position))
        added.site(WORLD, f"ground_{k}", numeric.placement(foot))
        kind = "connect" if support.kind == "point" else "weld"
        added.tie(kind, f"tie_{k}", f"ground_{k}", solimp=_SOLIMP)
    return added.model()
