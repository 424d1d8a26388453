"""Order operations limb by limb, for processors with few registers.

A sweep over the kinematic tree visits each limb once.  A limb has few values, and the body passes few values between
limbs.  If each visit of a limb is computed without interruption, the processor must keep only a few values at a time.
For example, nvcc stores 96 bytes of values per thread in memory for solo8 in this order, and 608 bytes in depth-first
order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pinocchio as pin

from impact_posture.codegen.block_layout import depth_first, leaves_of
from impact_posture.codegen.expression_graph import Graph


def limb_of_joints(model: pin.Model) -> list[int]:
    """Return the number of the limb of each joint; 0 for joints of the body.

    A limb is a chain of joints without branches, up to its end.
    """
    body = {j for i in range(model.njoints) if len(model.children[i]) > 1 for j in model.supports[i]}
    limbs = [0] * model.njoints
    for i in range(1, model.njoints):
        limbs[i] = 0 if i in body else limbs[model.parents[i]] or i
    return limbs


def limb_of_coordinates(model: pin.Model) -> dict[int, int]:
    """Return index in ``q`` → number of the limb (:func:`limb_of_joints`)."""
    limbs = limb_of_joints(model)
    return {
        k: limbs[i] for i in range(1, model.njoints) for k in range(model.idx_qs[i], model.idx_qs[i] + model.nqs[i])
    }


def limbs_of_nodes(
    graph: Graph, outputs: Sequence[str], visits: Sequence[tuple[int, int]], limb_of: Mapping[int, int]
) -> dict[int, int]:
    """Return node → number of the limb that computes the node, in the order of the sweeps; 0 for the body.

    ``visits`` are (node, limb) in the order in which the sweeps compute them, and ``limb_of`` is the result of
    :func:`limb_of_coordinates`.  A node belongs to the first visit that needs it.  There are two exceptions.  A node
    of the body whose operands all belong to one limb belongs to this limb.  A node of a limb that depends only on the
    body, and that other limbs use, belongs to the body.
    """
    nodes = graph.nodes
    order = depth_first(graph, [k for name in outputs for k in graph.outputs[name]])
    leaves, needed = leaves_of(graph, order), set(order)
    limb: dict[int, int] = {}
    for k in leaves:
        node = nodes[k] if nodes[k].op in ("const", "in") else nodes[nodes[k].args[0]]
        limb[k] = limb_of[node.args[1]] if node.op == "in" and graph.inputs[node.args[0]] == "q" else 0
    swept = list[int]()
    roots = [k for name in outputs for k in graph.outputs[name]]
    for root, number in [*((k, number) for k, number in visits if k in needed), *((k, 0) for k in roots)]:
        for k in depth_first(graph, [root], limb):
            limb[k] = number
            swept.append(k)
    above = {k: {limb[a] for a in nodes[k].operands if nodes[a].op != "const"} for k in swept}
    for k in swept:
        if limb[k] == 0 and len(above[k]) == 1:
            (limb[k],) = above[k]
    # Nodes of limbs that depend only on nodes of the body.
    free: set[int] = set()
    users: dict[int, set[int]] = {}
    for k in swept:
        if all(a in free or nodes[a].op == "const" or limb[a] == 0 for a in nodes[k].operands):
            free.add(k)
    for k in reversed(swept):
        if k in free and users.get(k, set()) - {limb[k]}:
            limb[k] = 0
        for a in nodes[k].operands:
            users.setdefault(a, set()).add(limb[k])
    return {k: limb[k] for k in swept}


def stages_of_nodes(graph: Graph, limbs: Mapping[int, int]) -> dict[int, int]:
    """Return node → number of its stage: a node is in a later stage than its operands of other limbs.

    ``limbs`` is the result of :func:`limbs_of_nodes`.
    """
    stages: dict[int, int] = {}
    for k, limb in limbs.items():
        inner = [a for a in graph.nodes[k].operands if a in limbs]
        stages[k] = max((stages[a] + (limbs[a] != limb) for a in inner), default=0)
    return stages


def order_by_limb(graph: Graph, limbs: Mapping[int, int]) -> list[int]:
    """Return the nodes of :func:`limbs_of_nodes` and their operands, in the best order for one thread."""
    stages = stages_of_nodes(graph, limbs)
    leaves = {a for k in limbs for a in graph.nodes[k].operands if a not in limbs}
    return [*sorted(leaves), *sorted(limbs, key=lambda k: (stages[k], limbs[k]))]
