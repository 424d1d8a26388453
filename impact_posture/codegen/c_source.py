"""Generate the C and CUDA code that templates insert: functions of an export, their blocks, and batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from impact_posture.codegen.block_layout import lay_out
from impact_posture.codegen.c_emitter import BlockText, Constants, Emitter
from impact_posture.codegen.c_literals import Real
from impact_posture.codegen.cuda_source import CudaSource, build_cuda_source
from impact_posture.codegen.export_library import Exported, ExportLibrary, NamedObjective, export_library
from impact_posture.codegen.expression_graph import ARITHMETIC, Graph
from impact_posture.codegen.function_text import angles_of, assignments, function_variables
from impact_posture.codegen.sum_order import reorder_sums
from impact_posture.config.cached_values import cached
from impact_posture.system.libraries import source_key

LARGEST_VECTOR = 64
"""Size of the widest vectors, bytes.  A batch with narrower vectors computes several together, up to this size."""

# Stack bytes for return addresses, saved registers, alignment and the variables of the small functions.  The stack
# contains the variables of only one block at a time, because the macro APART prevents the inlining of blocks.
_FRAMES = 2048
# With -march=native, a compiler can combine neighboring numbers into vectors.  With vectors, the code uses at most
# this factor more stack, because several vectors may contain the same number.
_SPILL = 2

# Largest number of statements in a block of a batch.  A block of this size fits the first-level cache while it
# computes one group of configurations after the other.
_BATCH_BLOCK = 60


@dataclass(frozen=True)
class CSource:
    """C code of all functions of an export.

    Attributes:
        portable: Whether the code is plain C99 without vectors.
        constants: C definitions of the tables of constants.
        blocks: Blocks that the functions call.
        angles: Index in ``q`` of each angle whose sine and cosine are computed.
        room: Length of the arrays of sines and cosines.
        work: C type, name and length of each work array.
        functions: Template variables of each function that computes one configuration: ``stem``, ``name``, ``normal``
            (the constant normal; ``None`` if the normal is a parameter), ``calls`` (statements that call the blocks),
            ``outputs`` (target, value, whether the value is constant), and ``finite`` (name and length of each
            result).
        batches: Template variables of each batch function: ``stem``, ``normal``, ``scale`` (C literal of the ratio of
            the objective to ``H``; empty if the ratio is not constant), and ``blocks``.  A batch with blocks also has
            ``angles``, ``room``, ``work`` and ``outputs``.  A batch without blocks is a loop over single calls.
        stack_bytes: Upper bound on the stack that a call uses, in bytes, without the functions of the C library.
        cuda: CUDA code of the same functions; ``None`` if it was not requested.
    """

    portable: bool
    constants: str
    blocks: tuple[BlockText, ...]
    angles: tuple[int, ...]
    room: int
    work: tuple[tuple[str, str, int], ...]
    functions: tuple[dict[str, Any], ...]
    batches: tuple[dict[str, Any], ...]
    stack_bytes: int
    cuda: CudaSource | None = None


def build_c_source(
    exported: Sequence[NamedObjective], prefix: str, real: Real, *, portable: bool = False, cuda: bool = False
) -> CSource:
    """Generate the C code of the objectives of one robot, or read the code from the cache of the user.

    ``portable`` code does not use vectors, so compilers other than GCC and Clang can compile it.  With ``cuda``, also
    generate CUDA code.
    """
    library, lean = export_library(exported), export_library(exported, lean=True) if cuda else None
    models = [
        (v.stem, v.joint, v.free, v.objective.contact, v.objective.scale, v.objective.is_multiple_of_H)
        for v in exported
    ]
    content = (library.constants, library.seeds, library.functions, models, prefix, real, portable)
    functions = [each.function.serialize() for each in (library, lean) if each is not None]
    key = source_key([ca.CasadiMeta.version(), repr(content), *functions], "codegen")
    return cached("code", key, CSource, lambda: _generate(exported, library, lean, prefix, real, portable=portable))


def _generate(
    exported: Sequence[NamedObjective],
    library: ExportLibrary,
    lean: ExportLibrary | None,
    prefix: str,
    real: Real,
    *,
    portable: bool,
) -> CSource:
    single = [v for v in exported if not v.joint]
    # The code of an objective of several contacts contains the normal of its first contact.
    normals = {v.stem: (single[0] if v.joint else v).objective.contact.normal for v in exported}
    robot = single[0].objective.robot
    scalars = library.graph()
    # In a call for one configuration, the processor waits for results of operations, so a good order of sums saves
    # time.  In a batch, the processor computes other configurations meanwhile, so the batch uses the original order.
    graph = reorder_sums(scalars if portable else library.vector_graph())
    layout = lay_out(graph, [f.outputs for f in library.functions])
    constants = Constants(prefix, real)
    # The names of types occur thousands of times, so they are short macros.
    types = {1: real.name, 2: "V2", 4: "V4"}
    emitter = Emitter(layout, prefix, real, types, constants)
    angles = angles_of(layout)
    whole = 1 if portable else LARGEST_VECTOR // real.size
    room = max(1, -(-len(angles) // whole)) * whole
    functions = []
    for number, function in enumerate(library.functions):
        blocks = zip(layout.blocks, emitter.blocks, strict=True)
        calls = [text.call for block, text in blocks if number in block.functions]
        functions.append(function_variables(function, emitter, calls, normals))
    numbers = sum(width * count for width, count in layout.sizes.items()) + 3 * room
    frames = [max(_SPILL * b.local_bytes, b.local_bytes + b.wide_bytes) for b in emitter.blocks]
    largest = real.size * numbers + max(frames, default=0)
    batches = []
    for v in single:
        scale = real.literal(v.objective.scale) if v.objective.is_multiple_of_H else ""
        batch = {"stem": v.stem, "normal": v.objective.contact.normal, "scale": scale, "blocks": ()}
        function = next(f for f in library.functions if (f.stem, f.name) == (v.stem, "eval"))
        # For the robot without supports, the batch is a loop, because vector code would make the file a third longer.
        if not portable and not v.free and (lanes := _lanes(function, scalars, real, constants)):
            held = 2 * lanes["room"] + lanes["work"] + robot.nq + 3 + 2 * (1 + robot.nv)
            frame = max((block.local_bytes for block in lanes["blocks"]), default=0)
            largest = max(largest, LARGEST_VECTOR * held + frame)
            batch |= lanes
        batches.append(batch)
    work = [(types[width], f"w{width if width > 1 else ''}", count) for width, count in sorted(layout.sizes.items())]
    scales = {str(batch["stem"]): str(batch["scale"]) for batch in batches}
    cuda_source = build_cuda_source(lean, robot.model, normals, scales, prefix, real) if lean else None
    stack_bytes = -(-(largest + _FRAMES) // 64) * 64
    return CSource(
        portable, constants.text(types), tuple(emitter.blocks), angles, room, tuple(work), tuple(functions),
        tuple(batches), stack_bytes, cuda_source,
    )  # fmt: skip


def _lanes(function: Exported, scalars: Graph, real: Real, constants: Constants) -> dict[str, Any]:
    """Return the template variables of a batch in vector form; empty if an operation has no vector form in C."""
    layout = lay_out(scalars, [function.outputs], _BATCH_BLOCK)
    computed = {k for block in layout.blocks for k in block.nodes} | layout.inlined
    if not all(k in layout.trig or scalars.nodes[k].op in ARITHMETIC for k in computed):
        return {}
    emitter = Emitter(layout, f"{function.stem}_lanes", real, {1: "VN"}, constants, LARGEST_VECTOR, "work[g]")
    return {
        "blocks": emitter.blocks,
        "angles": angles_of(layout),
        # An array in C cannot have the length zero.
        "room": max(1, len(layout.angles)),
        "work": layout.sizes.get(1, 1),
        "outputs": [*assignments(function, emitter, "m->")],
    }
