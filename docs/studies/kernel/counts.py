"""Count the operations of H with ∇H, in instructions of CasADi and in the graph from which our C code is written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import casadi as ca

from impact_posture.codegen.export_library import NamedObjective, export_library
from impact_posture.codegen.expression_graph import ARITHMETIC, COSINE, SINE, Graph
from impact_posture.impact.worst_case_objective import WorstCaseObjective

# Number of operations by kind: "add" (and subtract), "mul", "div", "trig" (sines and cosines), "neg" (sign changes).
Operations = Counter[str]
_INSTRUCTIONS = {
    ca.OP_ADD: "add", ca.OP_SUB: "add", ca.OP_MUL: "mul", ca.OP_SQ: "mul", ca.OP_TWICE: "mul", ca.OP_DIV: "div",
    ca.OP_INV: "div", ca.OP_SIN: "trig", ca.OP_COS: "trig", ca.OP_NEG: "neg",
}  # fmt: skip
_NODES = {"+": "add", "-": "add", "*": "mul", "inv": "div", "neg": "neg", SINE: "trig", COSINE: "trig"}


def total(operations: Operations) -> int:
    """Count all operations except sign changes, which compilers merge into other operations."""
    return operations.total() - operations["neg"]


def of_function(function: ca.Function) -> Operations:
    """Count the operations in the C code that CasADi generates for a function."""
    kinds = (_INSTRUCTIONS.get(function.instruction_id(k)) for k in range(function.n_instructions()))
    return Counter(kind for kind in kinds if kind)


def of_export(objective: WorstCaseObjective) -> tuple[Operations, int | None]:
    """Count the operations of one call of the exported ``eval``, without and with vector instructions.

    A call runs only the blocks that its outputs need, so only the reachable part of the graph is counted.  In the
    second number, a vector instruction for all repeated limbs counts once, but each sine and cosine counts.  The
    second number is ``None`` for a robot without repeated limbs.  Ignoring the order of sums changes the count by at
    most 1 %.
    """
    exported = export_library([NamedObjective(objective, "kernel")])
    outputs = next(f.outputs for f in exported.functions if f.name == "eval")
    graph = exported.graph()
    kinds = (_NODES.get(graph.nodes[k].op) for k in _reached(graph, outputs))
    single = Counter(kind for kind in kinds if kind)
    if not exported.seeds:
        return single, None
    graph = exported.vector_graph()
    done = sum(graph.nodes[k].op in ARITHMETIC - {"neg"} for k in _reached(graph, outputs))
    return single, done + single["trig"]


def _reached(graph: Graph, outputs: Sequence[str]) -> set[int]:
    needed: set[int] = set()
    waiting = [k for name in outputs for k in graph.outputs[name]]
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += graph.nodes[k].operands
    return needed
