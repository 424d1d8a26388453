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
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from impact_posture.benchmark.case import Case
from impact_posture.benchmark.dense import solved
from impact_posture.benchmark.generated import base_rotation, c_source, compiled, function_of
from impact_posture.benchmark.peer import Peer
from impact_posture.benchmark.workbench import Absent, Workbench
from impact_posture.robot.urdf import resolve_path, robots_data


def peers(case: Case, bench: Workbench) -> list[Peer]:
    """ADAM's C.

    Raises:
        Absent: ADAM is not installed, or cannot do this robot.
    """
    try:
        from adam import Representations
        from adam.casadi import KinDynComputations
    except ImportError as missing:
        raise Absent(f"{missing} (pip install adam-robotics)") from None
    if not case.plain:
        raise Absent("has no joints of several coordinates")
    robot = case.robot
    try:
        # Its URDF reader prints what it does not know.
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()), _mended(bench):
            kinematics = KinDynComputations(_urdf(case), list(robot.joint_names))
            kinematics.set_frame_velocity_representation(Representations.BODY_FIXED_REPRESENTATION)
            functions = (
                kinematics.mass_matrix_fun(),
                kinematics.jacobian_fun(case.frame),
                kinematics.forward_kinematics_fun(case.frame),
            )
    except Exception as failed:  # whatever its URDF reader raises
        raise Absent(f"cannot read this robot ({type(failed).__name__}: {failed})") from None
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
    source = c_source(function_of(q, n, step, H))
    return compiled("ADAM", "adam", "its M and J, LDLᵀ, CasADi's reverse mode and C", source, bench)


def _urdf(case: Case) -> str:
    """The robot's URDF with an ``<origin>`` in every ``<inertial>``: ADAM's reader fails without."""
    own = "impact-posture:"
    source = case.robot.source
    path = robots_data() / source.removeprefix(own) if source.startswith(own) else resolve_path(source, Path())
    root = ET.parse(path).getroot()
    for inertial in root.iter("inertial"):
        if inertial.find("origin") is None:
            ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    return ET.tostring(root, encoding="unicode")


@contextlib.contextmanager
def _mended(bench: Workbench) -> Iterator[None]:
    """ADAM 0.5 gives a prismatic joint a motion subspace of twelve rows, which fails in its mass matrix."""
    from adam.model.std_factories.std_joint import StdJoint

    original = StdJoint.motion_subspace

    def mended(joint: Any) -> Any:
        found = original(joint)
        if found.array.shape[0] == 6:
            return found
        note = "ADAM: motion subspace of prismatic joints cut from twelve rows to six"
        bench.notes.extend([note] if note not in bench.notes else [])
        axis = np.array(ca.DM(joint.axis.array)).ravel()
        return joint.math.vertcat(*[joint.math.asarray(float(v)) for v in (*axis, 0.0, 0.0, 0.0)])

    StdJoint.motion_subspace = mended
    try:
        yield
    finally:
        StdJoint.motion_subspace = original
