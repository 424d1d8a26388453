"""Arithmetic of H with ∇H, counted on CasADi's instructions and on the graph that our C is written from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import casadi as ca

from impact_posture.codegen.export_library import NamedObjective, export_library
from impact_posture.codegen.expression_graph import ARITHMETIC, COSINE, SINE, Graph
from impact_posture.impact.worst_case_objective import WorstCaseObjective

# How often: "add" (and subtract), "mul", "div", "trig" (sines and cosines), "neg" (sign changes).
Operations = Counter[str]
_INSTRUCTIONS = {
    ca.OP_ADD: "add", ca.OP_SUB: "add", ca.OP_MUL: "mul", ca.OP_SQ: "mul", ca.OP_TWICE: "mul", ca.OP_DIV: "div",
    ca.OP_INV: "div", ca.OP_SIN: "trig", ca.OP_COS: "trig", ca.OP_NEG: "neg",
}  # fmt: skip
_NODES = {"+": "add", "-": "add", "*": "mul", "inv": "div", "neg": "neg", SINE: "trig", COSINE: "trig"}


def total(operations: Operations) -> int:
    """All but sign changes, which compilers fold."""
    return operations.total() - operations["neg"]


def of_function(function: ca.Function) -> Operations:
    """What the C that CasADi writes of a function does."""
    kinds = (_INSTRUCTIONS.get(function.instruction_id(k)) for k in range(function.n_instructions()))
    return Counter(kind for kind in kinds if kind)


def of_export(objective: WorstCaseObjective) -> tuple[Operations, int | None]:
    """What one call of ``eval`` of the export does, on single numbers; and how many operations vectors make of it.

    A call runs the blocks that its outputs need and no others, so the reach of the graph is the count.  The second
    number counts operations as the C has them, where those on the numbers of repeated limbs are one; its sines and
    cosines are still one each; ``None``: no repeated limbs.  The order in which the C adds up sums is not looked at:
    it moves the count by a hundredth at most.
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
