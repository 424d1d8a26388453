"""Write the C text of a controller: generated dynamics, tables of its structure, and the files of ``c/``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np

from impact_posture.codegen.block_layout import lay_out
from impact_posture.codegen.c_emitter import BlockText, Constants, Emitter
from impact_posture.codegen.c_literals import DOUBLE, c_double
from impact_posture.codegen.export_files import environment
from impact_posture.codegen.expression_graph import graph_of
from impact_posture.codegen.sum_order import reorder_sums
from impact_posture.config.problem_settings import Vector3
from impact_posture.controller_export.controller_parameters import RULES, Field
from impact_posture.controller_export.controller_structure import Structure
from impact_posture.controller_export.daqp_sources import VERSION
from impact_posture.controller_export.moving_tree import MovingTree
from impact_posture.dynamics.model_parameters import ModelParameters
from impact_posture.impact.impact_contact import point_on
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot import support_polygon
from impact_posture.robot.robot import Robot
from impact_posture.system.arrays import Array
from impact_posture.system.escape import c_comment
from impact_posture.tsid import controller, relaxation, support_contact
from impact_posture.tsid.flow import (
    flow_direction,
    flow_governor,
    flow_probes,
    redundancy,
    reference_flow,
    static_controls,
    zero_moment_point,
)
from impact_posture.tsid.qp import level_rank
from impact_posture.version import __version__

# Files of the folder c/, in the order in which they are joined.
_CORE = (
    "vector.c", "eigen.c", "manifold.c", "algebra.c", "tasks.c", "contacts.c", "qp.c", "rank.c", "solve.c",
    "give_way.c", "reference_flow_space.c", "reference_flow_limits.c", "reference_flow_zmp.c",
    "reference_flow_direction.c", "reference_flow.c", "reference_flow_motion.c", "posture.c", "init.c", "tick.c",
    "report.c",
)  # fmt: skip
_RELAXATION = (
    "relaxation_memory.c", "vector.c", "relaxation_rows.c", "relaxation_elimination.c", "relaxation_level.c",
    "relaxation_cost.c", "relaxation.c",
)  # fmt: skip
# Parameters that ``init`` compares with other parameters.  The C code needs a named index for each of these
# parameters.
_NAMED = ("control_upper", "joint_upper", "contact_normal", "law_rate", "posture_weight", "task_weight")
# Module → names of its constants that the C code uses; the module describes them.
_CONSTANTS = {
    controller: "LONGEST ABSURD",
    relaxation: "OFF",
    support_contact: "ACROSS",
    support_polygon: "ON_LINE",
    level_rank: "SINGULAR DROPPED LEAST",
    reference_flow: "PROBE MOVED REACHED STILL SLOW UPDATE_TICKS UNTIL SINCE",
    flow_probes: "NEW",
    flow_direction: "LEAST_VALUE LEVEL NEAR SPENT AIM RESERVE FLAT",
    flow_governor: "ATTEMPTS ABLE CAUTION RATE RETURN",
    redundancy: "SLACK SPRING IDLE",
    static_controls: "MOMENT LEFT EVEN TINY",
    zero_moment_point: "ZMP_SHARE ZMP_LEAST",
}
# Stack bytes of a tick apart from arrays: variables, saved registers and return addresses of all functions.
_FRAMES = 4096


@dataclass(frozen=True)
class GeneratedCode:
    """C code that computes the quantities in ``ip_model``, or an objective.

    Attributes:
        constants: C definitions of constant tables.
        blocks: C functions that each compute a part of the quantities.
        angles: Indices of the entries of ``q`` whose sine and cosine are used.
        work: Length of the work array.
        outputs: Assignments after the calls of the blocks, as pairs of target and value.
        constant_outputs: Assignments of values that do not depend on the state.
        stack_bytes: Upper bound on the stack usage, bytes.
    """

    constants: str
    blocks: Sequence[BlockText]
    angles: tuple[int, ...]
    work: int
    outputs: list[tuple[str, str]]
    constant_outputs: list[tuple[str, str]]
    stack_bytes: int


@lru_cache(maxsize=2)
def dynamics_code(
    robot: Robot, points: tuple[tuple[str, Vector3, bool], ...], *, shared: bool = False
) -> GeneratedCode:
    """Generate the dynamics of a robot and the kinematics of points.

    Each point is a frame, an offset, and whether the rotation of the frame is needed.  With ``shared``, the code
    reads the numbers of :class:`~impact_posture.dynamics.model_parameters.ModelParameters` at run time.
    """
    q, v = ca.SX.sym("q", robot.nq), ca.SX.sym("v", robot.nv)
    numbers = ModelParameters(robot.model) if shared else None
    tree = MovingTree(robot.model, q, v, numbers)
    quantities: dict[str, ca.SX] = {"M": tree.mass_matrix(), "h": tree.bias()}
    if robot.floating:
        quantities["base"] = tree.rotations[1]
    for k, (frame, offset, turns) in enumerate(points):
        on, rows = point_on(robot, frame, offset), 6 if turns else 3
        spatial, velocity = tree.spatial_drift(on), tree.velocity(on)
        drift = spatial + ca.vertcat(ca.cross(velocity[3:], velocity[:3]), ca.SX(3, 1))
        quantities[f"position[{k}]"] = tree.position(on)
        quantities[f"jacobian[{k}]"] = tree.jacobian(on)[:rows, :]
        quantities[f"velocity[{k}]"], quantities[f"drift[{k}]"] = velocity[:rows], drift[:rows]
        if rows == 6:
            quantities[f"rotation[{k}]"], quantities[f"spatial[{k}]"] = tree.rotation(on), spatial
    # Transpose the matrices, because the C code stores them row by row, and CasADi column by column.
    targets = {f"d->{name}[{{}}]": x.T for name, x in quantities.items()}
    return _generated({"q": q, "v": v} | ({} if numbers is None else {"numbers": numbers.symbol}), targets)


@lru_cache(maxsize=2)
def objective_code(objective: WorstCaseObjective) -> GeneratedCode:
    """Generate an objective and its gradient, as code that reads the numbers of the model at run time."""
    q, numbers = ca.SX.sym("q", objective.robot.nq), ModelParameters(objective.robot.model)
    kernel = ImpactKernel(objective.case, q, ca.SX(ca.DM(objective.contact.normal)), numbers)
    targets = dict(zip(("value[{}]", "gradient[{}]"), objective.worst_case.expressions(kernel), strict=True))
    return _generated({"q": q, "numbers": numbers.symbol}, targets)


def _generated(inputs: dict[str, ca.SX], targets: dict[str, ca.SX]) -> GeneratedCode:
    names = [f"o{k}" for k in range(len(targets))]
    function = ca.Function("code", [*inputs.values()], [*targets.values()], [*inputs], names, {"cse": True})
    graph = reorder_sums(graph_of(function))
    layout = lay_out(graph, [names])
    constants = Constants("ip", DOUBLE)
    emitter = Emitter(layout, "ip", DOUBLE, {1: "double"}, constants)
    outputs: list[tuple[str, str]] = []
    fixed: list[tuple[str, str]] = []
    for name, target in zip(names, targets, strict=True):
        for k, node in enumerate(graph.outputs[name]):
            known = graph.nodes[node].op == "const"
            (fixed if known else outputs).append((target.format(k), emitter.output(node)))
    angles = tuple(graph.nodes[k].args[1] for k in layout.angles)
    work = layout.sizes.get(1, 1)
    largest = max((block.local_bytes for block in emitter.blocks), default=0)
    stack = 8 * (work + 2 * len(angles)) + largest
    return GeneratedCode(constants.text({1: "double"}), emitter.blocks, angles or (0,), work, outputs, fixed, stack)


def render(
    s: Structure,
    fields: Sequence[Field],
    prefix: str,
    identity: str,
    metric: str | None,
    objective: WorstCaseObjective | None = None,
    *,
    shared: bool = False,
) -> dict[str, str]:
    """Return file name → text of the header and the sources, whose C names begin with ``prefix``.

    The library contains the ``identity`` of the manifest.  C names of the gradient begin with ``metric``; ``None``
    means no gradient.  If ``objective`` is not ``None``, the files contain the result of :func:`objective_code`;
    otherwise, the caller exports the gradient.  With ``shared``, the last parameter is ``numbers``, and robots with
    the same code differ only in these numbers.
    """
    points, robot = tuple((p.frame, p.offset, p in s.turning) for p in s.points), s.robot
    code = dynamics_code(robot, points, shared=shared)
    sizes = s.sizes
    tables = [(name, *table(values)) for name, values in s.tables.items()]
    tables.append(("gravity", *table(np.array(robot.model.gravity.linear, dtype=float))))
    tables.append(("allocation", *table(s.actuators.G[: sizes["BASE"], : sizes["ROTORS"]])))
    named_fields = [(field.name, k) for k, field in enumerate(fields, 1) if field.name in _NAMED]
    context: dict[str, Any] = {
        "robot": robot.name, "version": __version__, "prefix": prefix, "sizes": sizes, "room": _room(sizes),
        "q_names": list(robot.q_names), "v_names": robot.tangent_names, "u_names": s.actuators.names,
        "convention": robot.convention, "tasks": [t.name for t in s.tasks] or ["none"], "metric": metric,
        "fields": fields, "shared": fields[-1].value.size if shared else 0,
        "stack_bytes": -(-max(code.stack_bytes, _solver_stack(sizes)) // 64) * 64 + _FRAMES,
        "identity": identity, "tables": tables, "named": named_fields, "literals": _initializer,
        "rules": _braced(str(x) for f in fields for x in (f.value.size, RULES[f.rule])),
        "constants": [(name, repr(getattr(module, name)), module.__name__.rpartition(".")[2])
                      for module, names in _CONSTANTS.items() for name in names.split()],
        "core": "\n".join(core_text(name) for name in _files(sizes)),
    }  # fmt: skip
    templates = environment("impact_posture.controller_export", c_comment)
    files = [
        (f"{prefix}.h", "controller.h", None),
        (f"{prefix}.c", "controller.c", None),
        (f"{prefix}_defaults.c", "defaults.c", None),
        (f"{prefix}_dynamics.h", "dynamics.h", None),
        (f"{prefix}_dynamics.c", "dynamics.c", code),
        *([] if objective is None else [(f"{metric}.c", "dynamics.c", objective_code(objective))]),
    ]
    texts = {}
    for name, template, part in files:
        generated: dict[str, Any] = {"objective": part is not code}
        generated |= {} if part is None else {"code": part, "places": _braced(map(str, part.angles))}
        texts[name] = templates.get_template(f"{template}.jinja").render(context | generated)
    texts = {name: named(text, prefix) for name, text in texts.items()}
    for name, text in relaxation_sources().items():
        text = re.sub(r"\b(daqp\.h|relaxation\.h)", rf"{prefix}_\1", text)
        texts[f"{prefix}_{name}"] = named(text, prefix)
    return texts


def build_files(prefix: str, sources: Sequence[str]) -> dict[str, str]:
    """Return the Makefile and the CMake file of a controller; ``sources`` are its sources besides ``<prefix>.c``."""
    templates = environment("impact_posture.controller_export", c_comment)
    return {
        name: templates.get_template(template).render(prefix=prefix, sources=sources, daqp=VERSION)
        for name, template in (("Makefile", "controller.mk.jinja"), ("CMakeLists.txt", "controller.cmake.jinja"))
    }


def _files(sizes: dict[str, int]) -> list[str]:
    needed = {"eigen.c": sizes["ROBUST"] or sizes["FLOW"]}
    needed |= {name: sizes["FLOW"] for name in _CORE if name.startswith("reference_flow")}
    return [name for name in _CORE if needed.get(name, True)]


def _room(sizes: dict[str, int]) -> dict[str, int]:
    """Return name → length of the arrays in the C code, at least 1: the ``sizes``, and further arrays."""
    nv, equations, levels = sizes["NV"], sizes["EQUATIONS"], 1 + sizes["LEVELS"]
    n, held, rows = sizes["VARIABLES"], sizes["HELD"], sizes["FLOW_ROWS"]
    more = {
        "SCRATCH": max(3 * nv * nv, 2 * n * (n + equations) + 2 * equations * equations),
        "BOUNDS": sizes["SIMPLE"] + sizes["GENERAL"],
        "GAVE": levels,
        "RELAXATION": _relaxation_room(n, sizes["GENERAL"] - sizes["BOUNDED"], levels),
        "FLOW_WORK": max(3 * held * held + held * nv, 2 * nv * nv, rows * nv),
    }
    return {name: max(1, value) for name, value in (sizes | more).items()}


def _solver_stack(sizes: dict[str, int]) -> int:
    n, bounds = sizes["VARIABLES"] + 1, max(sizes["SIMPLE"] + sizes["GENERAL"], 2 * sizes["FLOW_ROWS"])
    return 8 * (n * (n + 1) // 2 + 12 * n + 2 * bounds + 16 * sizes["NV"]) + 2048


def _relaxation_room(n: int, m: int, levels: int) -> int:
    """Return an upper bound on the number of doubles that the relaxation needs; ``init`` checks this bound."""
    entries, active = n + m, 2 * n + m + 2
    matrices = 2 * n * n + m * n + 3 * entries * n + active * (active + 1) // 2
    return matrices + 16 * n + 7 * active + (20 + levels) * entries + 64


def relaxation_sources() -> dict[str, str]:
    """Return file name → text of the relaxation, whose C names have no prefix yet."""
    return {
        "relaxation.h": core_text("relaxation.h"),
        "relaxation.c": "\n".join(core_text(name) for name in _RELAXATION),
    }


def named(text: str, prefix: str) -> str:
    """Return C text in which all names that begin with ``ip`` begin with ``prefix`` instead."""
    text = re.sub(r"\brelaxation_([a-z])", rf"{prefix}_relaxation_\1", text)
    return re.sub(r"\bip_", f"{prefix}_", re.sub(r"\bIP_", f"{prefix.upper()}_", text))


def core_text(name: str) -> str:
    """Return the text of a file in the folder ``c/``."""
    return (resources.files(__package__) / "c" / name).read_text(encoding="utf-8")


def _braced(texts: Any) -> str:
    return "{" + ", ".join(texts) + "}"


def _initializer(values: Array) -> str:
    return _braced(c_double(float(x)).strip("()") for x in values)


def table(values: Array) -> tuple[str, str, str]:
    """Return the C type of a table, its length, and its initializer; an empty table gets one zero."""
    values = values.ravel() if values.size else np.zeros(1, dtype=values.dtype)
    if values.dtype == np.int64:
        return "int", str(values.size), _braced(str(x) for x in values.tolist())
    return "double", str(values.size), _initializer(values)
