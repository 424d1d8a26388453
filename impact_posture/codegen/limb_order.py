"""Order operations limb by limb, for processors with few registers.

A sweep over the kinematic tree visits each limb once.  A limb has few values, and the body passes few values between
limbs.  If each visit of a limb is computed without interruption, the processor must keep only a few values at a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pinocchio as pin

from impact_posture.codegen.block_layout import depth_first
from impact_posture.codegen.expression_graph import COSINE, SINE, Graph


def limb_of_coordinates(model: pin.Model) -> dict[int, int]:
    """Return index in ``q`` → number of the limb; 0 for joints of the body.

    A limb is a chain of joints without branches, up to its end.
    """
    body = {j for i in range(model.njoints) if len(model.children[i]) > 1 for j in model.supports[i]}
    limbs = [0] * model.njoints
    for i in range(1, model.njoints):
        limbs[i] = 0 if i in body else limbs[model.parents[i]] or i
    return {
        k: limbs[i] for i in range(1, model.njoints) for k in range(model.idx_qs[i], model.idx_qs[i] + model.nqs[i])
    }


def order_by_limb(graph: Graph, outputs: Sequence[str], limb_of: Mapping[int, int]) -> list[int]:
    """Return the nodes that the outputs need, in the order in which they should be computed.

    ``limb_of`` is the result of :func:`limb_of_coordinates`.
    """
    nodes = graph.nodes
    order = depth_first(graph, [k for name in outputs for k in graph.outputs[name]])
    leaves = {k for k in order if nodes[k].op in ("const", "in")}
    leaves |= {k for k in order if nodes[k].op in (SINE, COSINE) and nodes[nodes[k].args[0]].op == "in"}
    limb = _limbs(graph, order, leaves, limb_of)
    visit = dict.fromkeys(leaves, 0)
    for k in order:
        if k not in leaves:
            visit[k] = max((visit[a] + (limb[a] != limb[k]) for a in nodes[k].operands if a not in leaves), default=0)
    return sorted(order, key=lambda k: (k not in leaves, visit[k], limb[k]))


def _limbs(graph: Graph, order: Sequence[int], leaves: set[int], limb_of: Mapping[int, int]) -> dict[int, int]:
    """Return node → limb on whose joints the node depends; 0 if it depends on no limb or on several limbs.

    A value that depends on the body and on one limb belongs to the limb.  A partial sum over limbs that only the body
    uses is an exception: it belongs to no limb.
    """
    nodes, limb = graph.nodes, dict[int, int]()
    users: dict[int, set[int]] = {}
    for k in order:
        node = nodes[k]
        if node.op == "in":
            limb[k] = limb_of[node.args[1]] if graph.inputs[node.args[0]] == "q" else 0
            continue
        limbs = {limb[a] for a in node.operands} - {0}
        limb[k] = limbs.pop() if len(limbs) == 1 else 0
        for a in node.operands:
            users.setdefault(a, set()).add(k)
    for k in reversed(order):
        of_body = any(limb[a] == 0 and nodes[a].op != "const" for a in nodes[k].operands)
        if k not in leaves and of_body and all(limb[u] == 0 for u in users.get(k, ())):
            limb[k] = 0
    return limb
