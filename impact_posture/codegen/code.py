"""Data for ``templates/source.c.jinja``: the functions of an export, the blocks that they share, and the batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from impact_posture.codegen.emitter import BlockText, Constants, Emitter, Real
from impact_posture.codegen.functions import Exported, Library, library
from impact_posture.codegen.graph import ARITHMETIC, Graph
from impact_posture.codegen.layout import Layout, lay_out
from impact_posture.codegen.naming import SIGNATURES, lengths
from impact_posture.codegen.sums import rebuilt
from impact_posture.codegen.variants import Variant
from impact_posture.impact.objective import ImpactObjective

LARGEST_VECTOR = 64
"""Bytes of the widest vectors that the source uses, and of the widest group of narrower vectors in a batch."""

# Blocks have frames of their own (APART), so one of them is on the stack at a time, and a compiler stores no more in
# it than the variables of the block.  Where a compiler joins functions, the variables of all of them may get places.
# This covers return addresses, saved registers, alignment and the variables of the small functions.
_FRAMES = 2048
# With -march=native a compiler makes vectors of neighboring numbers, and stores some numbers in several vectors.
_SPILL = 2

# So few statements of a block of the batch stay in the first cache of the processor from group to group.
_BATCH_BLOCK = 60


@dataclass(frozen=True)
class Output:
    """An assignment of a result.

    Attributes:
        target: The C expression on its left.
        value: The C expression on its right.
        constant: Whether the value is the same at every configuration.
    """

    target: str
    value: str
    constant: bool


@dataclass(frozen=True)
class FunctionCode:
    """One exported function.

    Attributes:
        stem: Beginning of its C name.
        name: Rest of its C name.
        normal: The constant normal, if the function has no parameter for one.
        calls: Calls of its blocks.
        outputs: Assignments of its results.
        finite: Name and length of each result.
    """

    stem: str
    name: str
    normal: tuple[float, float, float] | None
    calls: tuple[str, ...]
    outputs: tuple[Output, ...]
    finite: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class BatchCode:
    """Functions of one objective that do not stand on blocks of their own.

    Attributes:
        stem: Beginning of the C names.
        normal: Normal of the objective.
        scale: Literal of the objective over ``H``, if it is a multiple of ``H``; else empty.
        blocks: Blocks on vectors of configurations; empty for a loop over single calls.
        angles: Index in ``q`` of each angle.
        work: Length of the work array.
        outputs: Assignments of the results.
    """

    stem: str
    normal: tuple[float, float, float]
    scale: str
    blocks: tuple[BlockText, ...] = ()
    angles: tuple[int, ...] = ()
    work: int = 1
    outputs: tuple[Output, ...] = ()

    @property
    def room(self) -> int:
        """Length of the arrays of sines and cosines; C has no arrays of length zero."""
        return max(1, len(self.angles))


@dataclass(frozen=True)
class Code:
    """Functions of an export.

    Attributes:
        portable: Whether the code is plain C99 without vectors.
        constants: Tables of numbers.
        blocks: Blocks that the functions share.
        angles: Index in ``q`` of each angle whose sine and cosine are computed.
        room: Length of the arrays of sines and cosines.
        work: C type, name and length of each work array.
        functions: Functions of one configuration.
        batches: Functions of each objective beside those.
        stack_bytes: Upper bound on the stack of a call, without that of the C library.
    """

    portable: bool
    constants: str
    blocks: tuple[BlockText, ...]
    angles: tuple[int, ...]
    room: int
    work: tuple[tuple[str, str, int], ...]
    functions: tuple[FunctionCode, ...]
    batches: tuple[BatchCode, ...]
    stack_bytes: int


def build_code(exported: Sequence[Variant], prefix: str, real: Real, *, portable: bool = False) -> Code:
    """Generate the functions of each objective.

    Args:
        exported: The objectives, all of one robot.
        prefix: Beginning of the names of everything that functions share.
        real: The C type to compute in.
        portable: Use no vectors, for compilers that have none.
    """
    single = [v for v in exported if not v.joint]
    joint = next(((v.objective, v.stem) for v in exported if v.joint), None)
    found = library([v.objective for v in single], [v.stem for v in single], joint)
    scalars = found.graph()
    graph = scalars if portable else found.vector_graph()
    # A single call waits for results more than for arithmetic units.  A batch has other lanes to go on with.
    layout = lay_out(rebuilt(graph), [f.outputs for f in found.functions])
    constants = Constants(prefix, real)
    # The names of types stand in thousands of places, so they are short.  The source undefines them at its end.
    types = {1: real.name, 2: "V2", 4: "V4"}
    emitter = Emitter(layout, prefix, real, types, constants)
    angles = _angles(layout)
    whole = 1 if portable else LARGEST_VECTOR // real.size
    room = max(1, -(-len(angles) // whole)) * whole
    robot = single[0].objective.robot
    numbers = sum(width * count for width, count in layout.sizes.items()) + 3 * room
    frames = [max(_SPILL * b.local_bytes, b.local_bytes + b.wide_bytes) for b in emitter.blocks]
    largest = real.size * numbers + max(frames, default=0)
    batches = []
    for variant in single:
        objective = variant.objective
        scale = real.literal(objective.scale) if objective.is_multiple_of_H else ""
        batch = BatchCode(variant.stem, objective.contact.normal, scale)
        # A batch of the free robot beside one that stands would be another third of the source, so it is a loop.
        if not (portable or variant.free):
            lanes = _batch(batch, scalars, found, real, constants)
            if lanes is not None:
                batch, frame = lanes
                held = 2 * batch.room + batch.work + robot.nq + 3 + 2 * (1 + robot.nv)
                largest = max(largest, LARGEST_VECTOR * held + frame)
        batches.append(batch)
    return Code(
        portable,
        constants.text(types),
        tuple(emitter.blocks),
        angles,
        room,
        tuple((types[width], f"w{width if width > 1 else ''}", size) for width, size in sorted(layout.sizes.items())),
        tuple(_functions(found, layout, emitter, [v.objective for v in single], [v.stem for v in single])),
        tuple(batches),
        -(-(largest + _FRAMES) // 64) * 64,
    )


def _angles(layout: Layout) -> tuple[int, ...]:
    """Index in ``q`` of each angle."""
    return tuple(layout.graph.nodes[k].args[1] for k in layout.angles)


def _functions(
    found: Library, layout: Layout, emitter: Emitter, objectives: Sequence[ImpactObjective], stems: Sequence[str]
) -> Iterator[FunctionCode]:
    of = dict(zip(stems, objectives, strict=True))
    for number, function in enumerate(found.functions):
        calls = [
            text.call for block, text in zip(layout.blocks, emitter.blocks, strict=True) if number in block.functions
        ]
        inputs, results = SIGNATURES[function.name]
        # The objective of several contacts at once takes the normal of the leading contact; the others are constants.
        contact = of.get(function.stem, objectives[0]).contact
        yield FunctionCode(
            function.stem,
            function.name,
            None if "n" in inputs else contact.normal,
            tuple(calls),
            tuple(_outputs(function, layout, emitter, "m.")),
            tuple(
                (name, len(layout.graph.outputs[output]))
                for name, output in zip(results, function.outputs, strict=True)
            ),
        )


def _outputs(function: Exported, layout: Layout, emitter: Emitter, work: str) -> Iterator[Output]:
    arrays = lengths(0, 0)
    for name, output in zip(SIGNATURES[function.name][1], function.outputs, strict=True):
        for k, node in enumerate(layout.graph.outputs[output]):
            target = f"{name}[{k}]" if name in arrays else f"*{name}"
            yield Output(target, emitter.output(node, work), layout.graph.nodes[node].op == "const")


def _batch(
    loop: BatchCode, scalars: Graph, found: Library, real: Real, constants: Constants
) -> tuple[BatchCode, int] | None:
    """The batch on vectors with the bytes of its largest block; ``None`` where an operation has no vector form."""
    function = next(f for f in found.functions if (f.stem, f.name) == (loop.stem, "eval"))
    layout = lay_out(scalars, [function.outputs], _BATCH_BLOCK)
    if not _vectorizable(layout):
        return None
    emitter = Emitter(layout, f"{loop.stem}_lanes", real, {1: "VN"}, constants, LARGEST_VECTOR, "work[g]")
    batch = BatchCode(
        loop.stem,
        loop.normal,
        loop.scale,
        tuple(emitter.blocks),
        _angles(layout),
        layout.sizes.get(1, 1),
        tuple(_outputs(function, layout, emitter, "m->")),
    )
    return batch, max((block.local_bytes for block in emitter.blocks), default=0)


def _vectorizable(layout: Layout) -> bool:
    """Whether C has every operation of a layout on vectors."""
    return all(
        k in layout.trig or layout.graph.nodes[k].op in ARITHMETIC
        for k in {k for block in layout.blocks for k in block.nodes} | layout.inlined
    )
