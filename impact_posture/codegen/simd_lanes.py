"""Find the operations that twin branches have in common and let vectors do them: one lane a branch.

An operation's key is its kind and its operands' keys, where a twin's own angles and constants have the key of their
place in the branch.  Operations of all the lanes of a group with one key become one operation on vectors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from impact_posture.codegen.graph import ARITHMETIC, COSINE, SINE, Graph, Node

# What an operand is to the key of an operation: a node of its own, or a place among twins.
Key = tuple[object, ...]


@dataclass(frozen=True)
class Seed:
    """An input that twins have each of their own.

    Attributes:
        group: Number of the group of branches.
        lane: Which branch of it.
        name: The same for all twins.
    """

    group: int
    lane: int
    name: str


def packed(graph: Graph, seeds: Mapping[tuple[str, int], Seed], values: Mapping[str, Sequence[float]]) -> Graph:
    """The same computation with vectors for what twins share.

    Args:
        graph: Operations on single numbers.
        seeds: Input name and index → its place among twins.
        values: Inputs that are constants after all, by name.
    """
    widths: dict[int, int] = {}
    for seed in seeds.values():
        widths[seed.group] = max(widths.get(seed.group, 0), seed.lane + 1)
    places = (
        {
            k: seeds[name, node.args[1]]
            for k, node in enumerate(graph.nodes)
            if node.op == "in" and (name := graph.inputs[node.args[0]], node.args[1]) in seeds
        }
        if seeds
        else {}
    )
    bundles = _bundles(graph, places, widths)
    return _merge(graph, bundles, values)


def _bundles(graph: Graph, places: Mapping[int, Seed], widths: Mapping[int, int]) -> dict[int, tuple[int, ...]]:
    """Node → the nodes that one vector holds, itself among them.

    Level by level from the inputs: operations with one key lie equally deep, so whether all lanes have one is known
    before anything is built on them.  Where a lane lacks it, or has it twice, they are shared nodes like any other.
    """
    bundles: dict[int, tuple[int, ...]] = {}
    lanes: dict[int, tuple[int, int]] = {}
    # What stands for a node in the keys of others: its own number, or that of the first of its bundle.
    short = list(range(len(graph.nodes)))
    for level in _levels(graph):
        found: dict[Key, dict[int, list[int]]] = {}
        for k in level:
            if (place := _place(graph, k, places, lanes, short)) is not None:
                key, lanes[k] = place
                found.setdefault(key, {}).setdefault(lanes[k][1], []).append(k)
        for by_lane in found.values():
            members = [k for nodes in by_lane.values() for k in nodes]
            if len(members) == len(by_lane) == widths[lanes[members[0]][0]]:
                bundle = tuple(by_lane[lane][0] for lane in sorted(by_lane))
                for k in bundle:
                    bundles[k], short[k] = bundle, bundle[0]
            else:
                for k in members:
                    del lanes[k]
    return bundles


def _levels(graph: Graph) -> list[list[int]]:
    """Nodes by the length of the longest way to them from an input or a constant."""
    depth: list[int] = []
    levels: list[list[int]] = []
    for k, node in enumerate(graph.nodes):
        depth.append(max((depth[a] + 1 for a in node.operands), default=0))
        while len(levels) <= depth[k]:
            levels.append([])
        levels[depth[k]].append(k)
    return levels


def _place(
    graph: Graph, k: int, places: Mapping[int, Seed], lanes: Mapping[int, tuple[int, int]], short: list[int]
) -> tuple[Key, tuple[int, int]] | None:
    """A node's key with its group and lane; ``None`` where it is in none."""
    node = graph.nodes[k]
    if k in places:
        place = places[k]
        return ("seed", place.group, place.name), (place.group, place.lane)
    if node.op in ARITHMETIC or _of_input(graph, node):
        inside = {lanes[a] for a in node.operands if a in lanes}
        if len(inside) == 1:
            own = inside.pop()
            operands = [short[a] for a in node.operands]
            return (node.op, own[0], *(sorted(operands) if node.op in "+*" else operands)), own
    return None


def _of_input(graph: Graph, node: Node) -> bool:
    return node.op in (SINE, COSINE) and graph.nodes[node.args[0]].op == "in"


def _merge(graph: Graph, bundles: Mapping[int, tuple[int, ...]], values: Mapping[str, Sequence[float]]) -> Graph:
    """A graph with vectors; constants that were inputs get their values."""
    found = Graph(graph.inputs)
    made: dict[int, int] = {}
    vectors: dict[tuple[int, ...], int] = {}

    def number(k: int) -> int:
        """The single number that node k is."""
        if k not in made:
            bundle = bundles[k]
            made[k] = found.element(vectors[bundle], bundle.index(k))
        return made[k]

    def leaf(node: Node) -> int:
        name = graph.inputs[node.args[0]]
        if name in values:
            return found.constant(values[name][node.args[1]])
        return found.add(node)

    def build(k: int) -> None:
        node = graph.nodes[k]
        if k not in bundles:
            if node.op == "in":
                made[k] = leaf(node)
            elif node.op == "const":
                made[k] = found.constant(*node.value)
            else:
                made[k] = found.add(Node(node.op, tuple(number(a) for a in node.operands)))
            return
        bundle = bundles[k]
        if node.op == "in":
            parts = [leaf(graph.nodes[m]) for m in bundle]
            if all(found.nodes[p].op == "const" for p in parts):
                vectors[bundle] = found.constant(*[found.nodes[p].value[0] for p in parts])
            else:
                vectors[bundle] = found.add(Node("gather", tuple(parts), len(parts)))
            return
        # An operand that all lanes share is a single number; the lanes' own are a vector in the same order.
        slots = [[graph.nodes[m].operands[s] for m in bundle] for s in range(len(node.operands))]
        if node.op in "+*" and len(slots) == 2:
            slots = _aligned(slots, bundles)
        operands = [
            vectors[bundles[slot[0]]] if slot[0] in bundles and len(set(slot)) > 1 else number(slot[0])
            for slot in slots
        ]
        width = max(found.nodes[o].width for o in operands)
        vectors[bundle] = found.add(Node(node.op, tuple(operands), width))

    for k in _order(graph, bundles):
        if k not in made and bundles.get(k) not in vectors:
            build(k)
    found.outputs = {name: [number(k) for k in nodes] for name, nodes in graph.outputs.items()}
    return found


def _aligned(slots: list[list[int]], bundles: Mapping[int, tuple[int, ...]]) -> list[list[int]]:
    """Operands of a sum or product, whose order says nothing, with each lane's in the order of the first's."""
    first = [s[0] for s in slots]
    rows = [list(slot) for slot in slots]
    for lane in range(1, len(slots[0])):
        ours, swapped = (slots[0][lane], slots[1][lane]), (slots[1][lane], slots[0][lane])
        fits = all(a == b or (a in bundles and b in bundles[a]) for a, b in zip(first, ours, strict=True))
        rows[0][lane], rows[1][lane] = ours if fits else swapped
    return rows


def _order(graph: Graph, bundles: Mapping[int, tuple[int, ...]]) -> list[int]:
    """Nodes with all operands of their whole bundle before them."""
    seen: set[int] = set()
    order: list[int] = []
    for root in range(len(graph.nodes)):
        stack = [(root, False)]
        while stack:
            k, ready = stack.pop()
            if ready:
                order.append(k)
                continue
            if k in seen:
                continue
            members = bundles.get(k, (k,))
            seen.update(members)
            stack.append((k, True))
            stack += [(a, False) for m in members for a in graph.nodes[m].operands if a not in seen]
    return order
