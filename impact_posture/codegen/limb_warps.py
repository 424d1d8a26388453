"""Divide a function among the warps of a CUDA block, so that each warp computes some limbs of the robot.

One thread cannot keep the values of a humanoid in its registers.  It stores most values in memory, and waits for the
memory.  Therefore, :data:`WARPS` threads, one of each warp, compute one configuration.  Each thread keeps only the
values of its limbs.  The warps compute in stages, wait for each other after each stage, and exchange the values of
limbs and body in shared memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from impact_posture.codegen.block_layout import (
    Block,
    Layout,
    assign_slots,
    depth_first,
    inlined_nodes,
    leaves_of,
    trig_nodes,
)
from impact_posture.codegen.expression_graph import Graph
from impact_posture.codegen.limb_order import stages_of_nodes

WARPS = 4
"""Number of warps that compute configurations together."""
LANES = 32
"""Number of threads of a warp, and of configurations that the warps compute together."""

# Cost of waiting for the other warps after a stage, as a number of operations.
_WAIT = 50
# Up to this number of limbs, all distributions of limbs among the warps are compared.
_COMPARED = 6
# Number of the limb, and earliest stage of its nodes.
Chunk = tuple[int, int]


@dataclass(frozen=True)
class WarpSchedule:
    """Stage and warp of every node.

    Attributes:
        stages: Node → number of its stage, in an order in which a warp can compute its nodes.
        warps: Node → number of the warp that computes the node.
        count: Number of stages.
        cost: Number of operations of the slowest warp in each stage, summed over the stages, and time of waiting.
    """

    stages: Mapping[int, int]
    warps: Mapping[int, int]
    count: int
    cost: int


def schedule(graph: Graph, limbs: Mapping[int, int]) -> WarpSchedule:
    """Distribute nodes among stages and warps so that the warps have nearly equal work in each stage.

    ``limbs`` is the result of :func:`~impact_posture.codegen.limb_order.limbs_of_nodes`.  The nodes of a limb with
    the same earliest stage are moved to a later stage if this reduces the cost.
    """
    earliest = stages_of_nodes(graph, limbs)
    chunk = {k: (limb, earliest[k]) for k, limb in limbs.items()}
    sizes = Counter(chunk.values())
    needed: dict[Chunk, set[Chunk]] = {c: set() for c in sorted(sizes, key=lambda c: c[1])}
    for k, c in chunk.items():
        needed[c] |= {chunk[a] for a in graph.nodes[k].operands if a in chunk} - {c}
    first: dict[Chunk, int] = {}
    best = _distribute(_loads(sizes, _stages(needed, first)))[1]
    for c in reversed(needed):
        for stage in range(c[1] + 1, max(earliest.values()) + 1):
            tried = first | {c: stage}
            if (cost := _distribute(_loads(sizes, _stages(needed, tried)))[1]) < best:
                first, best = tried, cost
    stages = _stages(needed, first)
    warp_of, cost = _distribute(_loads(sizes, stages))
    order = sorted(limbs, key=lambda k: stages[chunk[k]])
    return WarpSchedule(
        {k: stages[chunk[k]] for k in order},
        {k: warp_of[limbs[k]] for k in order},
        max(stages.values()) + 1,
        cost,
    )


def _stages(needed: Mapping[Chunk, set[Chunk]], first: Mapping[Chunk, int]) -> dict[Chunk, int]:
    """Return chunk → its stage, which is not earlier than in ``first``; ``needed`` maps a chunk to earlier chunks."""
    stages: dict[Chunk, int] = {}
    for c, earlier in needed.items():
        stages[c] = max([first.get(c, 0), *(stages[p] + (p[0] != c[0]) for p in earlier)])
    return stages


def _loads(sizes: Mapping[Chunk, int], stages: Mapping[Chunk, int]) -> Counter[tuple[int, int]]:
    """Return (stage, limb) → number of operations."""
    loads: Counter[tuple[int, int]] = Counter()
    for c, size in sizes.items():
        loads[stages[c], c[0]] += size
    return loads


def _cost(loads: Mapping[tuple[int, int], int], warp_of: Mapping[int, int]) -> int:
    work: dict[int, list[int]] = {}
    for (stage, limb), load in loads.items():
        if limb in warp_of:
            work.setdefault(stage, [0] * WARPS)[warp_of[limb]] += load
    return sum(max(each) + _WAIT for each in work.values())


def _distribute(loads: Mapping[tuple[int, int], int]) -> tuple[dict[int, int], int]:
    """Return limb → warp with a small cost, and the cost."""
    total: Counter[int] = Counter()
    for (_, limb), load in loads.items():
        total[limb] += load
    large = [limb for limb, _ in total.most_common(_COMPARED)]
    # The warps are alike, so the k-th limb needs to be tried only on the first k warps.
    choices = product(*[range(min(k + 1, WARPS)) for k in range(len(large))])
    warp_of = min((dict(zip(large, choice, strict=True)) for choice in choices), key=lambda w: _cost(loads, w))
    for limb, _ in total.most_common()[_COMPARED:]:
        warp_of = min((warp_of | {limb: warp} for warp in range(WARPS)), key=lambda w: _cost(loads, w))
    return warp_of, _cost(loads, warp_of)


def lay_out_warps(graph: Graph, outputs: Sequence[str], plan: WarpSchedule) -> Layout:
    """Return a layout with one block for each stage and warp that has nodes.

    A value that other warps use has an index in the shared array.  For each index, the array has one value for each
    lane of a warp.
    """
    order, results = [*plan.stages], {k for name in outputs for k in graph.outputs[name]}
    every = depth_first(graph, [*results])
    angles, trig = trig_nodes(graph, every)
    users: dict[int, list[int]] = {}
    for k in order:
        for a in set(graph.nodes[k].operands):
            users.setdefault(a, []).append(k)
    place = {k: (plan.stages[k], plan.warps[k]) for k in order}
    inlined = inlined_nodes(graph, order, users, results, place)
    blocks: dict[tuple[int, int], list[int]] = {}
    for k in order:
        if k not in inlined:
            blocks.setdefault(place[k], []).append(k)
    steps = [[k for at, nodes in blocks.items() if at[0] == stage for k in nodes] for stage in range(plan.count)]
    computed = [k for step in steps for k in step]
    # A node within a statement is in the same stage as the statement, so the last stage of the users is correct.
    last = {k: plan.count if k in results else max(plan.stages[u] for u in users[k]) for k in computed}
    shared = frozenset(k for k in computed if any(plan.warps[u] != plan.warps[k] for u in users.get(k, ())))
    own, sizes = assign_slots(graph, steps, last | dict.fromkeys(shared, -1))
    exchanged, size = assign_slots(graph, steps, {k: last[k] if k in shared else -1 for k in computed})
    return Layout(
        graph, tuple(Block(frozenset([0]), tuple(nodes)) for _, nodes in sorted(blocks.items())),
        frozenset(inlined), own | exchanged, sizes, angles, trig, leaves_of(graph, every), shared,
        size.get(1, 0),
    )  # fmt: skip
