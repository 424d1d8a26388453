"""Reorder sums: terms that are available first are added first, so that only the last term causes a delay."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from impact_posture.codegen.expression_graph import Graph, Node

# Approximate latency of operations on current processors, cycles.
_LATENCY = {"+": 4, "-": 4, "*": 4, "inv": 15, "neg": 1, "lane": 2, "const": 0, "in": 0, "gather": 1}
# Approximate latency of functions such as sine, cycles.
_TRIG = 40
# Two terms are added to each other before the sum only if this saves at least this number of cycles.  An addition of
# two terms takes extra time, because it cannot be part of a fused multiply-add.
_WORTH = 8


def reorder_sums(graph: Graph) -> Graph:
    """Return a graph with the same results, in which each sum first adds the terms that are available first."""
    reordered = Graph(graph.inputs)
    ready: list[int] = []
    new_of: dict[int, int] = {}
    inner = _inner(graph)

    def add(node: Node) -> int:
        k = reordered.add(node)
        while len(ready) < len(reordered.nodes):
            new = reordered.nodes[len(ready)]
            ready.append(max((ready[a] for a in new.operands), default=0) + _LATENCY.get(new.op, _TRIG))
        return k

    for k, node in enumerate(graph.nodes):
        if k in inner:
            continue
        if node.op in ("+", "-"):
            terms = [(sign, new_of[t]) for sign, t in _terms(graph, k, inner)]
            new_of[k] = _sum(reordered, add, ready, terms)
        else:
            operands = tuple(new_of[a] for a in node.operands)
            args = (operands[0], node.args[1]) if node.op == "lane" else operands if operands else node.args
            new_of[k] = add(Node(node.op, args, node.width, node.value))
    reordered.outputs = {name: [new_of[k] for k in nodes] for name, nodes in graph.outputs.items()}
    return reordered


def _inner(graph: Graph) -> set[int]:
    """Return the sums whose only use is as a term of another sum of the same width."""
    users: dict[int, set[int]] = {}
    times: Counter[int] = Counter()
    for k, node in enumerate(graph.nodes):
        for a in node.operands:
            users.setdefault(a, set()).add(k)
            times[a] += 1
    for nodes in graph.outputs.values():
        times.update(nodes)
    return {
        k
        for k, node in enumerate(graph.nodes)
        if node.op in ("+", "-")
        and times[k] == 1
        and k in users
        and all(graph.nodes[u].op in ("+", "-") and graph.nodes[u].width == node.width for u in users[k])
    }


def _terms(graph: Graph, root: int, inner: set[int]) -> list[tuple[int, int]]:
    """Return the sign and the node number of each term of the sum at ``root``, with inner sums expanded."""
    terms: list[tuple[int, int]] = []
    waiting = [(1, root)]
    while waiting:
        sign, k = waiting.pop()
        node = graph.nodes[k]
        if k == root or k in inner:
            second = sign if node.op == "+" else -sign
            waiting += [(second, node.args[1]), (sign, node.args[0])]
        else:
            terms.append((sign, k))
    return terms


def _sum(graph: Graph, add: Callable[[Node], int], ready: list[int], terms: list[tuple[int, int]]) -> int:
    """Return the sum of terms (pairs of sign and node number); the term that is available last is added last."""
    queue = sorted(terms, key=lambda term: (ready[term[1]], term[1]))

    def plus(first: tuple[int, int], second: tuple[int, int]) -> tuple[int, int]:
        # The sum of two single numbers is a single number; if one term is a vector, the sum is a vector.
        width = max(graph.nodes[first[1]].width, graph.nodes[second[1]].width)
        if first[0] == second[0]:
            return first[0], add(Node("+", (first[1], second[1]), width))
        positive, negative = (first, second) if first[0] > 0 else (second, first)
        return 1, add(Node("-", (positive[1], negative[1]), width))

    total = queue.pop(0)
    while queue:
        term = queue.pop(0)
        if queue and ready[total[1]] >= ready[queue[0][1]] + _WORTH:
            # The next two terms are available long before the present sum, so add them to each other first.
            term = plus(term, queue.pop(0))
        total = plus(total, term)
    return total[1] if total[0] > 0 else add(Node("neg", (total[1],), graph.nodes[total[1]].width))
