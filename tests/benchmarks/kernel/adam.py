"""ADAM with CasADi: its mass matrix and Jacobian, LDLᵀ, CasADi's reverse mode and code generator.

ADAM is parametrized by the base's homogeneous transform and the joint positions.  The transform here is that of
``q`` times the rotation ``1 + ε̂``; reverse mode with respect to (ε, joints) at ε = 0 is the tangent gradient in
the base's axes, and the base's position does not enter H.  BODY_FIXED is the representation whose M is Pinocchio's;
its Jacobian is in the frame's axes, so that the normal goes there.  Armature, which ADAM does not know, is added to
the diagonal; of a fixed base the rows and columns of its floating base are left out.
"""

from __future__ import annotations

import contextlib
import io
import xml.etree.ElementTree as ET
from collections.abc import Iterator

import casadi as ca
import numpy as np

from impact_posture.robot.loader import robots_data
from impact_posture.robot.urdf import resolve_path
from tests.benchmarks.kernel.build import Absent
from tests.benchmarks.kernel.case import Case
from tests.benchmarks.kernel.dense import solved
from tests.benchmarks.kernel.generated import base_rotation, c_source, compiled, function_of
from tests.benchmarks.kernel.peer import Peer


def peers(case: Case, notes: list[str]) -> list[Peer]:
    """ADAM's C.

    Raises:
        Absent: ADAM is not installed.
    """
    try:
        from adam import Representations
        from adam.casadi import KinDynComputations
    except ImportError as missing:
        raise Absent(f"{missing} (pip install adam-robotics)") from None
    robot = case.robot
    # Its URDF reader prints what it does not know.
    with contextlib.redirect_stderr(io.StringIO()), _mended_prismatic(notes):
        kinematics = KinDynComputations(_urdf(case), list(robot.joint_names))
        kinematics.set_frame_velocity_representation(Representations.BODY_FIXED_REPRESENTATION)
        functions = (
            kinematics.mass_matrix_fun(),
            kinematics.jacobian_fun(case.frame),
            kinematics.forward_kinematics_fun(case.frame),
        )
    q, n, step = ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3), ca.SX.sym("step", robot.nv)
    floating = robot.floating
    joints = q[7:] + step[6:] if floating else q + step
    rotation = base_rotation(q) @ (ca.SX.eye(3) + ca.skew(step[3:6])) if floating else ca.SX.eye(3)
    origin = q[:3] if floating else ca.SX.zeros(3)
    pose = ca.vertcat(ca.horzcat(rotation, origin), ca.DM([[0, 0, 0, 1]]))
    first = 0 if floating else 6
    M, J, axes = (f.call([pose, joints])[0] for f in functions)
    M, J, axes = M[first:, first:], J[:3, first:], axes[:3, :3]
    force = J.T @ (axes.T @ n)
    H = solved(M + ca.diag(ca.SX(np.array(robot.armature))), force)
    return compiled("ADAM, reverse AD", c_source(function_of(q, n, step, H)), notes)


def _urdf(case: Case) -> str:
    """The robot's URDF with an ``<origin>`` in every ``<inertial>``: ADAM's reader fails without."""
    base = robots_data() / case.robot.name
    root = ET.parse(resolve_path(case.robot.spec.model.urdf, base)).getroot()
    for inertial in root.iter("inertial"):
        if inertial.find("origin") is None:
            ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    return ET.tostring(root, encoding="unicode")


@contextlib.contextmanager
def _mended_prismatic(notes: list[str]) -> Iterator[None]:
    """ADAM 0.5 gives a prismatic joint a motion subspace of twelve rows, which fails in its mass matrix."""
    from adam.model.std_factories.std_joint import StdJoint

    original = StdJoint.motion_subspace

    def mended(joint: StdJoint) -> object:
        found = original(joint)
        if found.array.shape[0] == 6:
            return found
        note = "ADAM: motion subspace of prismatic joints cut from twelve rows to six"
        notes.extend([note] if note not in notes else [])
        axis = np.array(ca.DM(joint.axis.array)).ravel()
        return joint.math.vertcat(*[joint.math.asarray(float(v)) for v in (*axis, 0.0, 0.0, 0.0)])

    StdJoint.motion_subspace = mended
    try:
        yield
    finally:
        StdJoint.motion_subspace = original
