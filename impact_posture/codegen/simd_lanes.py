"""Find the operations that repeated limbs have in common, and let vectors do them with one SIMD lane for each limb.

The key of an operation is its kind and the keys of its operands.  An angle or constant of a limb has the key of its
place in the limb.  Operations of all lanes of a group with one key become one operation on vectors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from impact_posture.codegen.expression_graph import ARITHMETIC, COSINE, SINE, Graph, Node

# Identity of an operand in the key of an operation: the number of a node, or a place in a limb.
Key = tuple[object, ...]


@dataclass(frozen=True)
class LimbInput:
    """An input that each of several repeated limbs has.

    Attributes:
        group: Number of the group of limbs.
        lane: Number of the limb in the group.
        name: A name that the limbs share.
    """

    group: int
    lane: int
    name: str


def pack_lanes(
    graph: Graph, seeds: Mapping[tuple[str, int], LimbInput], values: Mapping[str, Sequence[float]]
) -> Graph:
    """Return the same computation with vectors for what repeated limbs share.

    Args:
        graph: Operations on single numbers.
        seeds: Input name and index → its place among repeated limbs.
        values: Values of the inputs that are constants, by name.
    """
    widths: dict[int, int] = {}
    for seed in seeds.values():
        widths[seed.group] = max(widths.get(seed.group, 0), seed.lane + 1)
    places = {
        k: seeds[graph.inputs[node.args[0]], node.args[1]]
        for k, node in enumerate(graph.nodes)
        if node.op == "in" and (graph.inputs[node.args[0]], node.args[1]) in seeds
    }
    levels = _levels(graph)
    return _merge(graph, levels, _bundles(graph, levels, places, widths), values)


def _levels(graph: Graph) -> list[list[int]]:
    """Nodes by the length of the longest path to them from an input or a constant."""
    depth: list[int] = []
    levels: list[list[int]] = []
    for k, node in enumerate(graph.nodes):
        depth.append(max((depth[a] + 1 for a in node.operands), default=0))
        while len(levels) <= depth[k]:
            levels.append([])
        levels[depth[k]].append(k)
    return levels


def _bundles(
    graph: Graph, levels: list[list[int]], places: Mapping[int, LimbInput], widths: Mapping[int, int]
) -> dict[int, tuple[int, ...]]:
    """Return node → the nodes in one vector with it, itself among them.

    Operations with one key lie equally deep.  So level by level it is known whether every lane has an operation
    before anything is built on it.  Where a lane has none, or two, the operations stay single.
    """
    bundles: dict[int, tuple[int, ...]] = {}
    lanes: dict[int, tuple[int, int]] = {}
    # In keys, a node stands for itself or for the first node of its bundle.
    short = list(range(len(graph.nodes)))
    for level in levels:
        by_key: dict[Key, dict[int, list[int]]] = {}
        for k in level:
            if (place := _place(graph, k, places, lanes, short)) is not None:
                key, lanes[k] = place
                by_key.setdefault(key, {}).setdefault(lanes[k][1], []).append(k)
        for by_lane in by_key.values():
            members = [k for nodes in by_lane.values() for k in nodes]
            if len(members) == len(by_lane) == widths[lanes[members[0]][0]]:
                bundle = tuple(by_lane[lane][0] for lane in sorted(by_lane))
                for k in bundle:
                    bundles[k], short[k] = bundle, bundle[0]
            else:
                for k in members:
                    del lanes[k]
    return bundles


def _place(
    graph: Graph, k: int, places: Mapping[int, LimbInput], lanes: Mapping[int, tuple[int, int]], short: list[int]
) -> tuple[Key, tuple[int, int]] | None:
    """Return the key of a node with its group and lane; ``None`` where it is in no lane or in several."""
    node = graph.nodes[k]
    if k in places:
        place = places[k]
        return ("seed", place.group, place.name), (place.group, place.lane)
    trigonometric = node.op in (SINE, COSINE) and graph.nodes[node.args[0]].op == "in"
    inside = {lanes[a] for a in node.operands if a in lanes}
    if len(inside) != 1 or not (node.op in ARITHMETIC or trigonometric):
        return None
    (group_lane,) = inside
    operands = [short[a] for a in node.operands]
    return (node.op, group_lane[0], *(sorted(operands) if node.op in "+*" else operands)), group_lane


def _merge(
    graph: Graph,
    levels: list[list[int]],
    bundles: Mapping[int, tuple[int, ...]],
    values: Mapping[str, Sequence[float]],
) -> Graph:
    """Return a graph with a vector for each bundle."""
    merged = Graph(graph.inputs)
    singles: dict[int, int] = {}
    vectors: dict[tuple[int, ...], int] = {}

    def number(k: int) -> int:
        """The single number of node k."""
        if k not in singles:
            bundle = bundles[k]
            singles[k] = merged.element(vectors[bundle], bundle.index(k))
        return singles[k]

    def leaf(node: Node) -> int:
        name = graph.inputs[node.args[0]]
        return merged.constant(values[name][node.args[1]]) if name in values else merged.add(node)

    def single(node: Node) -> int:
        if node.op == "in":
            return leaf(node)
        if node.op == "const":
            return merged.constant(*node.value)
        return merged.add(Node(node.op, tuple(number(a) for a in node.operands)))

    def vector(bundle: tuple[int, ...]) -> int:
        members = [graph.nodes[k] for k in bundle]
        if members[0].op == "in":
            parts = [leaf(node) for node in members]
            if all(merged.nodes[p].op == "const" for p in parts):
                return merged.constant(*[merged.nodes[p].value[0] for p in parts])
            return merged.add(Node("gather", tuple(parts), len(parts)))
        # Lanes share an operand that is a single number.  Their own operands are a vector in the same order.
        slots = [list(operands) for operands in zip(*[node.operands for node in members], strict=True)]
        if members[0].op in "+*":
            _align(slots, bundles)
        operands = [
            vectors[bundles[slot[0]]] if slot[0] in bundles and len(set(slot)) > 1 else number(slot[0])
            for slot in slots
        ]
        return merged.add(Node(members[0].op, tuple(operands), max(merged.nodes[o].width for o in operands)))

    # The nodes of a bundle lie in one level, and their operands in earlier ones.
    for k in (k for level in levels for k in level):
        if k not in bundles:
            singles[k] = single(graph.nodes[k])
        elif bundles[k] not in vectors:
            vectors[bundles[k]] = vector(bundles[k])
    merged.outputs = {name: [number(k) for k in nodes] for name, nodes in graph.outputs.items()}
    return merged


def _align(slots: list[list[int]], bundles: Mapping[int, tuple[int, ...]]) -> None:
    """Put the two operands of each lane's sum or product in the order of the first lane's."""
    first, second = slots
    for lane in range(1, len(first)):
        pairs = ((first[0], first[lane]), (second[0], second[lane]))
        if not all(a == b or (a in bundles and b in bundles[a]) for a, b in pairs):
            first[lane], second[lane] = second[lane], first[lane]
