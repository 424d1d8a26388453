"""Count this project's own arithmetic from the graph that its C is written from."""

from __future__ import annotations

from collections.abc import Sequence

from impact_posture.benchmark.count import Operations
from impact_posture.codegen.functions import NamedObjective, library
from impact_posture.codegen.graph import ARITHMETIC, COSINE, SINE, Graph
from impact_posture.impact.objective import ImpactObjective

_KINDS = {"+": "add", "-": "add", "*": "mul", "inv": "div", "neg": "neg", SINE: "trig", COSINE: "trig"}


def eval_operations(objective: ImpactObjective) -> Operations:
    """What one call of the export's ``eval`` does: H and ∇H.

    A call runs the blocks that its outputs need and no others, so the graph's reach is the count.  It is on single
    numbers, as the peers' sources are counted.  ``packed`` counts operations as the C has them, where those on the
    numbers of repeated limbs are one; its sines and cosines are still one each.  The order in which the C
    adds up sums is not looked at: it moves the count by a hundredth at most.
    """
    found = library([NamedObjective(objective, "kernel")])
    outputs = next(f.outputs for f in found.functions if f.name == "eval")
    single = operations_of(found.graph(), outputs)
    if not found.seeds:
        return single
    graph = found.vector_graph()
    done = sum(graph.nodes[k].op in ARITHMETIC - {"neg"} for k in _reached(graph, outputs))
    return Operations(single.add, single.mul, single.div, single.trig, single.neg, done + single.trig)


def operations_of(graph: Graph, outputs: Sequence[str]) -> Operations:
    """Operations of a graph on single numbers that some output needs."""
    counts = dict.fromkeys(("add", "mul", "div", "trig", "neg"), 0)
    for k in _reached(graph, outputs):
        kind = _KINDS.get(graph.nodes[k].op)
        if kind is not None:
            counts[kind] += 1
    return Operations(**counts)


def _reached(graph: Graph, outputs: Sequence[str]) -> set[int]:
    needed: set[int] = set()
    waiting = [k for name in outputs for k in graph.outputs[name]]
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += graph.nodes[k].operands
    return needed
