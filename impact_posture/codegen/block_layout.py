"""Divide a graph of operations into blocks.  Each block becomes a C function that the exported functions call."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass

from impact_posture.codegen.expression_graph import ARITHMETIC, COSINE, SINE, Graph

# Largest number of statements in a block.  A compiler needs disproportionately more time for long functions.
_BLOCK = 300
# Largest number of operations in a statement.
_STATEMENT = 12


@dataclass(frozen=True)
class Block:
    """A C function that computes a part of the graph.

    Attributes:
        functions: Numbers of the exported functions that call the block.
        nodes: The nodes that the block computes, in order; one statement computes each node.
    """

    functions: frozenset[int]
    nodes: tuple[int, ...]


@dataclass(frozen=True)
class Layout:
    """Blocks of a graph, and array indices for the values that later blocks use.

    Attributes:
        blocks: The blocks in the order in which they are called.
        inlined: Nodes that are computed inside the statement of the only operation that uses them.
        slots: Node that a later block uses → index of the node's value in the work array.
        sizes: Width (number of lanes of a vector) → length of the work array for values of this width.
        angles: Input nodes whose sine and cosine are computed, in the order of the arrays of sines and cosines.
        trig: Sine or cosine node → index of its first value in the array of sines or cosines.
        leaves: Nodes that need no statement: constants, inputs, lanes, and sines and cosines of inputs.
        shared: Nodes whose values are in the array that the warps of a CUDA block share, not in the work array.
        shared_size: Length of this array for one configuration.
    """

    graph: Graph
    blocks: tuple[Block, ...]
    inlined: frozenset[int]
    slots: Mapping[int, int]
    sizes: Mapping[int, int]
    angles: tuple[int, ...]
    trig: Mapping[int, int]
    leaves: frozenset[int]
    shared: frozenset[int] = frozenset()
    shared_size: int = 0


def lay_out(
    graph: Graph, functions: Sequence[Sequence[str]], block: int = _BLOCK, order: Sequence[int] = ()
) -> Layout:
    """Divide a graph into blocks of at most ``block`` statements.

    ``functions`` contains the names of the outputs of each exported function.  ``order`` contains the nodes that
    the functions need; by default, the order is depth first.
    """
    order = order or depth_first(graph, [k for names in functions for name in names for k in graph.outputs[name]])
    angles, trig = trig_nodes(graph, order)
    leaves = leaves_of(graph, order)
    needed = _needed(graph, functions, leaves)
    # Remove nodes that only the arrays of sines and cosines need, because no statement computes them.
    order = [k for k in order if k in needed]
    users: dict[int, list[int]] = {}
    for k in order:
        for a in set(_sources(graph, leaves, k)):
            users.setdefault(a, []).append(k)
    outputs = {_source(graph, k) for names in functions for name in names for k in graph.outputs[name]}
    inlined = inlined_nodes(graph, [k for k in order if k not in leaves], users, outputs, needed)
    groups: dict[frozenset[int], list[int]] = {}
    for k in order:
        if k not in inlined and k not in leaves:
            groups.setdefault(needed[k], []).append(k)
    blocks = [
        Block(mask, tuple(nodes[at : at + block]))
        for mask, nodes in sorted(groups.items(), key=lambda item: (-len(item[0]), sorted(item[0])))
        for at in range(0, len(nodes), block)
    ]
    at = {k: number for number, part in enumerate(blocks) for k in part.nodes}

    def home(k: int) -> int:
        """Return the number of the block whose statement computes node ``k``."""
        while k in inlined:
            (k,) = users[k]
        return at[k]

    last = {k: len(blocks) if k in outputs else max((home(u) for u in users.get(k, ())), default=-1) for k in at}
    slots, sizes = assign_slots(graph, [part.nodes for part in blocks], last)
    return Layout(graph, tuple(blocks), frozenset(inlined), slots, sizes, angles, trig, leaves)


def assign_slots(
    graph: Graph, steps: Sequence[Sequence[int]], last: Mapping[int, int]
) -> tuple[dict[int, int], dict[int, int]]:
    """Return indices in the work arrays for values that later steps use, and the lengths of the arrays.

    ``steps`` contains the nodes that each step computes; a step is a block, or several blocks that run at once.
    ``last[value]`` is the last step that uses the value.  After this step, another value can have the same index.
    """
    slots: dict[int, int] = {}
    sizes: dict[int, int] = {}
    free: dict[int, list[int]] = {}
    ending: dict[int, list[int]] = {}
    for number, step in enumerate(steps):
        for k in ending.pop(number - 1, ()):
            heapq.heappush(free.setdefault(graph.nodes[k].width, []), slots[k])
        for k in step:
            if last[k] <= number:
                continue
            width = graph.nodes[k].width
            if free.get(width):
                slots[k] = heapq.heappop(free[width])
            else:
                slots[k] = sizes.get(width, 0)
                sizes[width] = slots[k] + 1
            ending.setdefault(last[k], []).append(k)
    return slots, sizes


def _source(graph: Graph, k: int) -> int:
    """Return the vector node if ``k`` is a lane of a vector; otherwise return ``k``."""
    return graph.nodes[k].args[0] if graph.nodes[k].op == "lane" else k


def _sources(graph: Graph, leaves: Set[int], k: int) -> list[int]:
    return [] if k in leaves else [_source(graph, a) for a in graph.nodes[k].operands]


def leaves_of(graph: Graph, order: Sequence[int]) -> frozenset[int]:
    """Return the nodes of ``order`` that need no statement, as in :attr:`Layout.leaves`."""
    trig = trig_nodes(graph, order)[1]
    return frozenset(k for k in order if graph.nodes[k].op in ("const", "in", "lane") or k in trig)


def depth_first(graph: Graph, roots: Sequence[int], known: Collection[int] = ()) -> list[int]:
    """Return the nodes that the roots need.  Each operand comes shortly before the operation that uses the operand.

    The operand with the longest chain of operations comes last, so that its result is used immediately.  The nodes
    ``known`` are left out.
    """
    depth = graph.depths
    seen: set[int] = set()
    order: list[int] = []
    for root in roots:
        stack = [(root, False)]
        while stack:
            k, ready = stack.pop()
            if ready:
                order.append(k)
            elif k not in seen and k not in known:
                seen.add(k)
                stack.append((k, True))
                operands = sorted(graph.nodes[k].operands, key=lambda a: -depth[a])
                stack += [(a, False) for a in operands if a not in seen]
    return order


def trig_nodes(graph: Graph, order: Sequence[int]) -> tuple[tuple[int, ...], dict[int, int]]:
    """Return ``angles`` and ``trig`` of :class:`Layout`; vectors come first, so that they are aligned in memory."""
    trigonometric = [k for k in order if graph.nodes[k].op in (SINE, COSINE)]
    starts: dict[int, int] = {}
    angles: list[int] = []
    trig: dict[int, int] = {}
    for k in sorted(trigonometric, key=lambda k: -graph.nodes[k].width):
        argument = graph.nodes[k].args[0]
        members = graph.nodes[argument].args if graph.nodes[argument].op == "gather" else (argument,)
        if all(graph.nodes[m].op == "in" for m in members):
            if argument not in starts:
                starts[argument] = len(angles)
                angles += members
            trig[k] = starts[argument]
    return tuple(angles), trig


def _needed(graph: Graph, functions: Sequence[Sequence[str]], leaves: Set[int]) -> dict[int, frozenset[int]]:
    """Return node → numbers of the exported functions that need the node."""
    numbers: dict[int, set[int]] = {}
    for number, names in enumerate(functions):
        waiting = [_source(graph, k) for name in names for k in graph.outputs[name]]
        while waiting:
            k = waiting.pop()
            if number not in numbers.setdefault(k, set()):
                numbers[k].add(number)
                waiting += _sources(graph, leaves, k)
    return {k: frozenset(v) for k, v in numbers.items()}


def inlined_nodes(
    graph: Graph,
    order: Sequence[int],
    users: Mapping[int, list[int]],
    outputs: set[int],
    needed: Mapping[int, object],
) -> set[int]:
    """Return the arithmetic operations that only one other arithmetic operation uses.

    Both operations must have the same value in ``needed``, such as the functions that need them.
    """
    size: dict[int, int] = {}
    inlined: set[int] = set()
    for k in order:
        node, used_by = graph.nodes[k], users.get(k, ())
        size[k] = 1 + sum(size[a] for a in node.operands if a in inlined)
        if len(used_by) != 1 or k in outputs or node.op not in ARITHMETIC or size[k] >= _STATEMENT:
            continue
        user = graph.nodes[used_by[0]]
        times = Counter(_source(graph, a) for a in user.operands)[k]
        if times == 1 and k in user.operands and needed[used_by[0]] == needed[k] and user.op in ARITHMETIC:
            inlined.add(k)
    return inlined
