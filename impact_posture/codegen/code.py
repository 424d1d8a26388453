"""The functions of an export as C: shared blocks, the exported functions on top of them, and the batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from impact_posture.codegen import templates
from impact_posture.codegen.emitter import Constants, Dialect, Emitter, Real, c_vector
from impact_posture.codegen.functions import Exported, Library, library
from impact_posture.codegen.graph import ARITHMETIC, Graph, graph_of
from impact_posture.codegen.layout import Layout, lay_out
from impact_posture.codegen.simd_lanes import packed
from impact_posture.codegen.sums import rebuilt
from impact_posture.codegen.variants import Variant
from impact_posture.codegen.vectors import LARGEST_VECTOR, vector_text
from impact_posture.impact.objective import ImpactObjective

# The bound: blocks have frames of their own (APART), so one of them is there at a time, and a compiler puts by
# in it no more than the block's variables.  Where it joins functions, the variables of all of them may get places.
# Return addresses, saved registers, alignment and the small functions' own variables, for the calls in each other.
_FRAMES = 2048
# A compiler that makes vectors of neighboring numbers (-march=native) puts some by in several of them.
_SPILL = 2

# Statements a block of the batch: few enough to stay in the processor's first cache from group to group.
_BATCH_BLOCK = 60

_PARAMETERS = {
    "eval": "const {r} q[{nq}], const {r} n[3], {r} *H, {r} grad[{nv}]",
    "objective": "const {r} q[{nq}], {r} *value, {r} grad[{nv}]",
    "value": "const {r} q[{nq}], const {r} n[3], {r} *H",
    "jump": "const {r} q[{nq}], const {r} n[3], {r} a[{nv}], {r} *G, {r} *V",
    "ellipsoid": "const {r} q[{nq}], {r} L[9]",
}
_RESULTS = {
    "eval": ("*H", "grad"),
    "objective": ("*value", "grad"),
    "value": ("*H",),
    "jump": ("a", "*G", "*V"),
    "ellipsoid": ("L",),
}


@dataclass(frozen=True)
class Code:
    """The C of an export's functions.

    Attributes:
        vectors: Types and trigonometry.
        functions: Everything else.
        stack_bytes: Upper bound on the stack that a call takes, the C library's part not counted.
    """

    vectors: str
    functions: str
    stack_bytes: int


def build_code(exported: Sequence[Variant], prefix: str, real: Real, *, portable: bool = False) -> Code:
    """Generate the functions of each objective.

    Args:
        exported: What is exported, all of one robot.
        prefix: What the names of everything shared begin with.
        real: The C type to compute in.
        portable: Without vectors, for compilers that have none.
    """
    single = [v for v in exported if not v.joint]
    joint = next(((v.objective, v.stem) for v in exported if v.joint), None)
    objectives, names = [v.objective for v in single], [v.stem for v in single]
    # The free robot beside one that stands goes without lanes: its batch would be another third of the source.
    looped = {v.stem for v in exported if v.free}
    return _Writer(library(objectives, names, joint), objectives, names, prefix, real, portable, looped).code()


class _Writer:
    def __init__(
        self,
        found: Library,
        objectives: Sequence[ImpactObjective],
        names: Sequence[str],
        prefix: str,
        real: Real,
        portable: bool,
        looped: set[str],
    ) -> None:
        self._library, self._objectives, self._names = found, objectives, names
        self._prefix, self._real, self._portable, self._looped = prefix, real, portable, looped
        self._scalars = graph_of(found.function, {"constants": found.constants})
        graph = self._scalars
        if not portable:
            separate = graph_of(found.function)
            graph = packed(separate, found.seeds, {"constants": list(found.constants)})
        # One configuration at a time waits for results more than for units; a batch has other lanes to go on with.
        graph = rebuilt(graph)
        # Short: they stand in thousands of places.  The text takes the names back at its end.
        types = {1: real.name, 2: "V2", 4: "V4"}
        self._layout = lay_out(graph, [f.outputs for f in found.functions])
        self._constants = Constants(prefix, real)
        self._emitter = Emitter(self._layout, Dialect(prefix, real, types), real.size, self._constants)
        robot = objectives[0].robot
        self._sizes = {"nq": robot.nq, "nv": robot.nv}
        self._common = {"prefix": prefix, "upper": prefix.upper(), "real": real.name, **self._sizes}
        self._largest = 0

    def code(self) -> Code:
        """All of it."""
        texts = [*[block.text for block in self._emitter.blocks], self._begin()]
        for number, function in enumerate(self._library.functions):
            texts.append(self._function(number, function))
        for objective, stem in zip(self._objectives, self._names, strict=True):
            if objective.is_multiple_of_H:
                texts.append(
                    templates.OBJECTIVE_SCALED.substitute(
                        self._common,
                        stem=stem,
                        normal=c_vector(objective.contact.normal, real=self._real),
                        scale=self._real.literal(objective.scale),
                    )
                )
            texts.append(self._batch(stem))
        # Last, when all of them are known.
        texts.insert(0, self._constants.text(self._emitter.dialect.types))
        return Code(
            vector_text(self._prefix, self._real, portable=self._portable), "\n".join(texts), self._stack_bytes()
        )

    def _stack_bytes(self) -> int:
        size = self._real.size
        numbers = sum(width * count for width, count in self._layout.sizes.items()) + 3 * self._angles(self._layout)
        frames = [max(_SPILL * b.local_bytes, b.local_bytes + b.wide_bytes) for b in self._emitter.blocks]
        single = size * numbers + max(frames, default=0)
        return -(-(max(single, self._largest) + _FRAMES) // 64) * 64

    # ---- one configuration ------------------------------------------------------------------------------------

    def _angles(self, layout: Layout) -> int:
        """Length of the sines' array: whole vectors, one at least."""
        whole = 1 if self._portable else LARGEST_VECTOR // self._real.size
        return max(1, -(-len(layout.angles) // whole)) * whole

    def _begin(self) -> str:
        layout, angles = self._layout, self._angles(self._layout)
        count = len(layout.angles)
        gather, fill = "  int k = 0;\n", ""
        if count:
            gather, fill = self._gather(layout), templates.FILL.substitute(count=count)
        if angles > count:
            fill += templates.FILL_REST.substitute(angles=angles)
        kinds = self._emitter.dialect.types
        work = "".join(
            f"  {kinds[width]} w{width if width > 1 else ''}[{count}];\n"
            for width, count in sorted(layout.sizes.items())
        )
        return templates.BEGIN.substitute(self._common, angles=angles, work=work, gather=gather, fill=fill)

    @staticmethod
    def _gather(layout: Layout) -> str:
        """Where the angles stand in q."""
        places = [str(layout.graph.nodes[k].args[1]) for k in layout.angles]
        rows = ["    " + ", ".join(places[k : k + 20]) for k in range(0, len(places), 20)]
        return templates.GATHER.substitute(count=len(places), places=",\n".join(rows))

    def _function(self, number: int, function: Exported) -> str:
        blocks = zip(self._layout.blocks, self._emitter.blocks, strict=True)
        calls = [f"  {text.call}" for block, text in blocks if number in block.functions]
        own = _RESULTS[function.name]
        lines, finite = [], []
        for target, output in zip(own, function.outputs, strict=True):
            nodes = self._layout.graph.outputs[output]
            if target.startswith("*"):
                lines.append(f"  {target} = {self._emitter.output(nodes[0])};")
                finite.append(f"{self._prefix}_finite({target[1:]}, 1)")
            else:
                lines += [f"  {target}[{k}] = {self._emitter.output(node)};" for k, node in enumerate(nodes)]
                finite.append(f"{self._prefix}_finite({target}, {len(nodes)})")
        if function.name == "jump":
            # H stands where V goes.
            lines.append("  *V /= *G * *G;")
        normal = ""
        if function.name in ("objective", "ellipsoid"):
            # Of several contacts at once it is the leading one's; the others' are constants within.
            of = dict(zip(self._names, self._objectives, strict=True))
            contact = of.get(function.stem, self._objectives[0]).contact
            normal = f"  static const {self._real.name} n[3] = {c_vector(contact.normal, real=self._real)};\n"
        return templates.FUNCTION.substitute(
            self._common,
            stem=function.stem,
            name=function.name,
            parameters=_PARAMETERS[function.name].format(r=self._real.name, **self._sizes),
            normal=normal,
            calls="\n".join(calls),
            outputs="\n".join(lines),
            finite=" && ".join(finite),
        )

    # ---- many configurations ----------------------------------------------------------------------------------

    def _batch(self, stem: str) -> str:
        outputs = next(f.outputs for f in self._library.functions if (f.stem, f.name) == (stem, "eval"))
        layout = lay_out(self._scalars, [outputs], _BATCH_BLOCK)
        if self._portable or stem in self._looped or not _vectorizable(layout):
            return templates.BATCH_LOOP.substitute(self._common, stem=stem)
        emitter = Emitter(
            layout, Dialect(f"{stem}_lanes", self._real, {1: "VN"}, "work[g]"), LARGEST_VECTOR, self._constants
        )
        angles, work = max(1, len(layout.angles)), layout.sizes.get(1, 1)
        frame = max((block.local_bytes for block in emitter.blocks), default=0)
        held = 2 * angles + work + self._sizes["nq"] + 3 + 2 * (1 + self._sizes["nv"])
        self._largest = max(self._largest, LARGEST_VECTOR * held + frame)
        gather = fill = ""
        if layout.angles:
            count, lanes = len(layout.angles), f"{self._prefix.upper()}_LANES"
            gather = self._gather(layout).replace("  int k;\n", "")
            fill = templates.FILL_LANES.substitute(self._common, count=count, lanes=lanes)
        lines = []
        for target, output in zip(("*H", "grad[{}]"), outputs, strict=True):
            for k, node in enumerate(layout.graph.outputs[output]):
                text = emitter.output(node, "m->")
                if layout.graph.nodes[node].op != "const":
                    text = f"{self._prefix.upper()}_AT({text}, j)"
                lines.append(f"      {target.format(k)} = {text};")
        calls = [templates.CALL_GROUPS.substitute(call=block.call) for block in emitter.blocks]
        return "\n".join(block.text for block in emitter.blocks) + templates.BATCH.substitute(
            self._common,
            stem=stem,
            angles=angles,
            work=work,
            gather=gather,
            fill=fill,
            calls="".join(calls).rstrip(),
            outputs="\n".join(lines),
        )


def _vectorizable(layout: Layout) -> bool:
    """Whether all of it is what C does on vectors."""
    graph: Graph = layout.graph
    return all(
        k in layout.trig or graph.nodes[k].op in ARITHMETIC
        for k in {k for block in layout.blocks for k in block.nodes} | layout.inlined
    )
