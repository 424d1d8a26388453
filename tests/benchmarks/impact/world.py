"""The MuJoCo model of a robot in one posture, a plane below its contact point, its feet tied to where they are."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.mjcf import Mjcf, import_mujoco, pose
from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.contact import point_on
from impact_posture.impact.objective import ImpactObjective

Vector = NDArray[np.float64]

# Radius of the ball at the contact point, meters: any will do, since the ball touches at the point itself.
BALL = 0.01
# Height of the contact point above the plane, meters: all postures meet it in the same part of a step.
_GAP = 1e-6
# The stiffest constraint that MuJoCo takes, at any depth.
_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)


def with_surface(written: Mjcf, objective: ImpactObjective, q: Vector) -> Mjcf:
    """Add a ball at the contact point, the plane, and a tie for each support.

    Args:
        written: The robot, which is changed.
        objective: ImpactContact and supports.
        q: The posture that they are placed for, shape (nq,).
    """
    robot, oracle = objective.robot, objective.oracle.at(q)
    numeric, n = Numeric(robot.model).at(q), oracle.n.copy()
    mujoco, spec = import_mujoco(), written.spec
    option = spec.option
    option.gravity, option.integrator = np.zeros(3), mujoco.mjtIntegrator.mjINT_EULER
    option.cone, option.solver = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtSolver.mjSOL_NEWTON
    option.tolerance, option.iterations = 0.0, 200
    option.ls_tolerance, option.ls_iterations = 1e-6, 100
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT

    contact = point_on(robot, objective.contact.frame, objective.contact.offset)
    position = numeric.placement(contact).translation
    # The ball's lowest point is the contact point.
    center = numeric.data.oMi[contact.joint].actInv(position + BALL * n)
    written.add_geom(contact.joint, "ball", "sphere", (BALL,), pin.SE3(np.eye(3), center))
    written.add_plane("surface", position - _GAP * n, n)
    spec.add_pair(geomname1="surface", geomname2="ball", solimp=_SOLIMP, condim=1)

    for k, support in enumerate(objective.supports):
        foot = point_on(robot, support.frame, support.offset)
        written.body(foot.joint).add_site(name=f"tie_{k}", **pose(pin.SE3(foot.rotation, foot.position)))
        spec.worldbody.add_site(name=f"ground_{k}", **pose(numeric.placement(foot)))
        kind = mujoco.mjtEq.mjEQ_CONNECT if support.kind == "point" else mujoco.mjtEq.mjEQ_WELD
        spec.add_equality(
            type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, name1=f"tie_{k}", name2=f"ground_{k}", solimp=_SOLIMP
        )
    return written
