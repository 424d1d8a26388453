"""Kernels of our export and of other implementations.  Each public function returns kernels for one robot."""

from __future__ import annotations

import contextlib
import io
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from docs.studies.build import CONTRACT, Built, build, flag_sets
from docs.studies.core import say
from docs.studies.kernel.counts import of_export, of_function
from docs.studies.kernel.harness import Absent, Kernel, Samples, c_compiler
from impact_posture.codegen.export import export
from impact_posture.codegen.export_library import NamedObjective, export_library
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.spatial import quaternion_matrix
from impact_posture.dynamics.tree import Tree, Wrench
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.urdf import resolve_path, robots_data
from tests.support.tangent import composite_mass_matrix, tangent_map

_WRAPPER = """
int kernel_eval(const double *q, const double *n, double *H, double *grad)
{{
  const double *arg[{arg}];
  double *res[{res}];
  casadi_int iw[{iw}];
  double w[{w}];
  arg[0] = q;
  arg[1] = n;
  res[0] = H;
  res[1] = grad;
  return eval(arg, res, iw, w, 0);
}}
"""


def exported(objective: WorstCaseObjective, prefix: str) -> tuple[Iterator[tuple[str, Built]], float]:
    """Build the C export with each set of flags.  Return the builds by name, and the size of the source, kB."""
    with tempfile.TemporaryDirectory() as folder:
        export(objective, Path(folder), prefix=prefix, check=False)
        sources = {name: (Path(folder) / name).read_text(encoding="utf-8") for name in (f"{prefix}.c", f"{prefix}.h")}
    made = (
        (label, build(sources, c_compiler(), ["-std=c99", *flags, CONTRACT])) for label, flags in flag_sets().items()
    )
    return made, len(sources[f"{prefix}.c"].encode()) / 1e3


def ours(samples: Samples) -> list[Kernel]:
    """Return kernels of the export, and kernels that compute ∇H by central differences of the exported H."""
    builds, size = exported(samples.objective, "kernel")
    count, packed = of_export(samples.objective)
    kernels = []
    for label, built in builds:
        kinds = {"eval": "kernel_eval", "value": "kernel_value", "batch": "kernel_eval_batch"}
        functions = {kind: built.symbol(name) for kind, name in kinds.items()}
        kernels.append(Kernel(f"ours {label}", "ours", built, functions, count, packed, size))
        kernels.append(Kernel(f"differences {label}", "differences", built, {"differences": functions["value"]}))
    return sorted(kernels, key=lambda kernel: kernel.group != "ours")


def same_graph(samples: Samples) -> list[Kernel]:
    """Return kernels in which CasADi writes the C code for the expressions of our export, compiled with the same
    flags."""
    exported = export_library([NamedObjective(samples.objective, "kernel")])
    q, n, _ = exported.function.sx_in()
    values = exported.function.call([q, n, ca.DM(exported.constants)])
    outputs = next(f.outputs for f in exported.functions if f.name == "eval")
    wanted = [ca.densify(values[exported.function.index_out(name)]) for name in outputs]
    function = ca.Function("eval", [q, n], wanted, ["q", "n"], ["H", "grad"], {"cse": True})
    ways = {label: ["-std=c99", *flags] for label, flags in flag_sets().items()}
    return _printed("same graph", "same graph", function, ways)


def dense(samples: Samples) -> list[Kernel]:
    """Return kernels for the textbook method in CasADi: composite rigid bodies, LDLᵀ, reverse mode."""
    robot = samples.robot
    q, n, step = ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3), ca.SX.sym("step", robot.nv)
    # To first order in step, this vector is q ⊕ step.
    at, direction = q + tangent_map(Chart(robot.model), q) @ step, n
    if robot.floating:
        # M does not depend on the pose of the base, so keep the base fixed and express the normal in its axes.
        at = ca.vertcat(ca.DM([0, 0, 0, 0, 0, 0, 1]), at[7:])
        rest = quaternion_matrix(q[3:7]).T @ n
        direction = rest - ca.cross(step[3:6], rest)
    tree = Tree(robot.model, at)
    impact = Wrench(point_on(robot, samples.frame), direction, ca.SX.zeros(3))
    H = solved(composite_mass_matrix(tree), tree.generalized_force([impact]))
    return _by_reverse_mode("CasADi", "casadi", q, n, step, H)


def adam(samples: Samples) -> list[Kernel]:
    """Return kernels for the mass matrix and the Jacobian of ADAM, with LDLᵀ and reverse mode.

    The inputs of ADAM are the homogeneous transform of the base and the joint positions.  Here the transform of ``q``
    is multiplied by the rotation ``1 + ε̂``, so reverse mode with respect to (ε, joints) at ε = 0 gives the tangent
    gradient in the axes of the base.  H does not depend on the position of the base.  In the representation
    BODY_FIXED, M agrees with Pinocchio, and the Jacobian is in the axes of the frame, so the normal is expressed in
    these axes.  Armature, which ADAM does not have, is added to the diagonal.  For a fixed base, the rows and columns
    of the base are left out.

    Raises:
        Absent: ADAM is not installed, or does not support this robot.
    """
    try:
        from adam import Representations
        from adam.casadi import KinDynComputations
    except ImportError as missing:
        raise Absent(f"{missing} (pip install adam-robotics)") from None
    if not samples.plain:
        raise Absent("has no joints of several coordinates")
    robot, quiet = samples.robot, io.StringIO()
    try:
        # Redirect the output, because the URDF reader of ADAM prints unknown elements.
        with contextlib.redirect_stderr(quiet), contextlib.redirect_stdout(quiet), _prismatic_joints_repaired():
            kinematics = KinDynComputations(_urdf(samples), list(robot.joint_names))
            kinematics.set_frame_velocity_representation(Representations.BODY_FIXED_REPRESENTATION)
            functions = [kinematics.mass_matrix_fun(), kinematics.jacobian_fun(samples.frame)]
            functions.append(kinematics.forward_kinematics_fun(samples.frame))
    except Exception as failed:  # The URDF reader of ADAM raises various errors.
        raise Absent(f"cannot read this robot ({type(failed).__name__}: {failed})") from None
    q, n, step = ca.SX.sym("q", robot.nq), ca.SX.sym("n", 3), ca.SX.sym("step", robot.nv)
    floating = robot.floating
    rotation = quaternion_matrix(q[3:7]) @ (ca.SX.eye(3) + ca.skew(step[3:6])) if floating else ca.SX.eye(3)
    origin = q[:3] if floating else ca.SX.zeros(3)
    pose = ca.vertcat(ca.horzcat(rotation, origin), ca.DM([[0, 0, 0, 1]]))
    first, joints = (0, q[7:] + step[6:]) if floating else (6, q + step)
    M, J, axes = (f.call([pose, joints])[0] for f in functions)
    H = solved(M[first:, first:] + ca.diag(ca.SX(np.array(robot.armature))), J[:3, first:].T @ (axes[:3, :3].T @ n))
    return _by_reverse_mode("ADAM", "adam", q, n, step, H)


def solved(M: ca.SX, force: ca.SX) -> ca.SX:
    """Return ``H = aᵀa`` with ``M a = force`` by CasADi's sparse ``LDLᵀ``."""
    D, LT, order = ca.ldl(M)
    return ca.sumsqr(ca.ldl_solve(force, D, LT, order))


def _by_reverse_mode(label: str, group: str, q: ca.SX, n: ca.SX, step: ca.SX, H: ca.SX) -> list[Kernel]:
    """Return H and its gradient with respect to ``step`` at zero, with common subexpressions shared."""
    general = ca.Function("general", [q, n, step], [H, ca.densify(ca.gradient(H, step))])
    values = general.call([q, n, ca.DM.zeros(step.shape)])
    function = ca.Function("eval", [q, n], values, ["q", "n"], ["H", "grad"], {"cse": True})
    # Compile as GNU C, the usual dialect for C code of CasADi.
    return _printed(label, group, function, {"-O2": ["-O2"], "-O3 native": ["-O3", "-march=native"]})


def _printed(label: str, group: str, function: ca.Function, ways: dict[str, Sequence[str]]) -> list[Kernel]:
    """Compile the C code that CasADi generates for ``(q, n) → H, ∇H``."""
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("peer.c", {"with_header": False})
        generator.add(function)
        generator.generate(f"{folder}/")
        text = (Path(folder) / "peer.c").read_text(encoding="utf-8")
    sizes = {"arg": function.sz_arg(), "res": function.sz_res(), "iw": function.sz_iw(), "w": function.sz_w()}
    source = text + _WRAPPER.format(**{key: max(1, size) for key, size in sizes.items()})
    kernels = []
    for way, flags in ways.items():
        say(f"{label} {way}")
        built = build({"peer.c": source}, c_compiler(), [*flags, CONTRACT])
        functions, size = {"eval": built.symbol("kernel_eval")}, len(source.encode()) / 1e3
        kernels.append(Kernel(f"{label} {way}", group, built, functions, of_function(function), None, size))
    return kernels


def _urdf(samples: Samples) -> str:
    """Return the URDF with an ``<origin>`` in every ``<inertial>``, which the reader of ADAM needs."""
    scheme, source = "impact-posture:", samples.robot.source
    path = robots_data() / source.removeprefix(scheme) if source.startswith(scheme) else resolve_path(source, Path())
    root = ET.parse(path).getroot()
    for inertial in root.iter("inertial"):
        if inertial.find("origin") is None:
            ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    return ET.tostring(root, encoding="unicode")


@contextlib.contextmanager
def _prismatic_joints_repaired() -> Iterator[None]:
    """Correct an error of ADAM 0.5: reduce the motion subspace of prismatic joints from twelve rows to six."""
    from adam.model.std_factories.std_joint import StdJoint

    original = StdJoint.motion_subspace

    def repaired(joint: Any) -> Any:
        subspace = original(joint)
        if subspace.array.shape[0] == 6:
            return subspace
        axis = np.array(ca.DM(joint.axis.array)).ravel()
        return joint.math.vertcat(*[joint.math.asarray(float(v)) for v in (*axis, 0.0, 0.0, 0.0)])

    StdJoint.motion_subspace = repaired
    try:
        yield
    finally:
        StdJoint.motion_subspace = original
