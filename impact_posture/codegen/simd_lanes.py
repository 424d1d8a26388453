"""Replace equal operations of repeated limbs by one vector operation, with one SIMD lane for each limb.

Two operations are equal if they have the same key.  The key of an operation consists of its operator and the keys of
its operands.  The key of a joint angle or constant is its name within the limb.  If all limbs of a group have an
operation with the same key, these operations become one vector operation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from impact_posture.codegen.expression_graph import ARITHMETIC, COSINE, SINE, Graph, Node

# Equal operations of several limbs have equal keys.
Key = tuple[object, ...]


@dataclass(frozen=True)
class LimbInput:
    """Limb to which an input (a joint angle or a constant) belongs.

    Attributes:
        group: Number of the group of repeated limbs to which the input belongs.
        lane: Number of the limb in its group, which is its SIMD lane.
        name: Name of the input, equal for the corresponding inputs of all limbs of the group.
    """

    group: int
    lane: int
    name: str


def pack_lanes(
    graph: Graph, seeds: Mapping[tuple[str, int], LimbInput], values: Mapping[str, Sequence[float]]
) -> Graph:
    """Return a graph with the same results, in which vector operations replace equal operations of repeated limbs.

    ``seeds`` maps (input name, index) to the limb of the input.  ``values`` maps the name of each constant input to
    its values.
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
    """Return lists of nodes.  List k contains the nodes whose longest path from an input or constant has length k."""
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
    """Return node → all nodes of the vector to which the node belongs.

    Operations with the same key are in the same list of ``levels``, so the vectors of a list are complete before the
    next list is processed.  Operations become a vector only if each limb has exactly one operation with the same key.
    """
    bundles: dict[int, tuple[int, ...]] = {}
    lanes: dict[int, tuple[int, int]] = {}
    # Node → number that represents the node in keys: the first node of its vector.  A node without a vector
    # represents itself.
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
    """Return the key of a node, and its group and lane.

    Return ``None`` if the node cannot be in a vector, because its operands are in no lane or in several lanes, or
    because C cannot apply the operation to vectors.
    """
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
    """Return a graph in which one vector operation replaces the nodes of each tuple in ``bundles``."""
    merged = Graph(graph.inputs)
    singles: dict[int, int] = {}
    vectors: dict[tuple[int, ...], int] = {}

    def number(k: int) -> int:
        """Return the number in the new graph of the old node ``k``."""
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
        # An operand is a single number that all lanes use, or a vector with the same order of lanes.
        slots = [list(operands) for operands in zip(*[node.operands for node in members], strict=True)]
        if members[0].op in "+*":
            _align(slots, bundles)
        operands = [
            vectors[bundles[slot[0]]] if slot[0] in bundles and len(set(slot)) > 1 else number(slot[0])
            for slot in slots
        ]
        return merged.add(Node(members[0].op, tuple(operands), max(merged.nodes[o].width for o in operands)))

    # All nodes of a vector are in the same list of ``levels``, and all their operands are in earlier lists.
    for k in (k for level in levels for k in level):
        if k not in bundles:
            singles[k] = single(graph.nodes[k])
        elif bundles[k] not in vectors:
            vectors[bundles[k]] = vector(bundles[k])
    merged.outputs = {name: [number(k) for k in nodes] for name, nodes in graph.outputs.items()}
    return merged


def _align(slots: list[list[int]], bundles: Mapping[int, tuple[int, ...]]) -> None:
    """Exchange the two operands of a sum or product in each lane whose operand order differs from the first lane."""
    first, second = slots
    for lane in range(1, len(first)):
        pairs = ((first[0], first[lane]), (second[0], second[lane]))
        if not all(a == b or (a in bundles and b in bundles[a]) for a, b in pairs):
            first[lane], second[lane] = second[lane], first[lane]
