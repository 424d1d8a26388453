"""Write C99 code for a layout.

A block is a function without branches.  Its values are local variables, or entries of work arrays if later blocks use
the values.  Names are short, because the code of a humanoid has ten thousand operations.  Vectors use an extension of
GCC and Clang, in which arithmetic operators also apply to vectors.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from impact_posture.codegen.block_layout import Block, Layout
from impact_posture.codegen.c_literals import Real
from impact_posture.codegen.expression_graph import COSINE, Node
from impact_posture.codegen.limb_warps import LANES

# Number of characters of a reference to a table of constants, such as K[1234].  Shorter literals are written
# directly.
_PLACE = 7
SHORT_NAMES = ("APART", "K", "K2", "K4", "V2", "V2u", "V4", "V4u", "VN")
"""Names of the macros that the generated C file defines, and undefines at its end."""

# Arrays that can be parameters of a block in addition to the inputs: sines, cosines, a work array for each vector
# width, and the array that the warps of a CUDA block share.
_SHARED = ("s", "c", "w", "w2", "w4", "wx")
# A compiler splits vectors that are wider than the vectors of the processor.  Without optimization, the compiler
# stores the whole vector and its parts, which takes twice the stack.
_HALVES = 2


@dataclass(frozen=True)
class BlockText:
    """C code of a block.

    Attributes:
        text: Definition of the C function.
        call: C statement that calls the function, with the names of arrays in the caller (inputs, ``m.s``, ``m.w``,
            …).
        local_bytes: Upper bound on the stack bytes of its local variables.
        wide_bytes: Upper bound on the additional stack bytes for vectors wider than the vectors of the processor.
    """

    text: str
    call: str
    local_bytes: int
    wide_bytes: int


class Constants:
    """C tables of the constants of a library, because a reference to a table is shorter than the number."""

    def __init__(self, prefix: str, real: Real, qualifiers: str = "static const") -> None:
        self._prefix, self._real, self._qualifiers = prefix, real, qualifiers
        self._tables: dict[int, dict[tuple[float, ...], int]] = {}

    def place(self, node: Node) -> str:
        """Return the C expression of a constant: a short literal, or a reference to a table."""
        if node.width == 1:
            text = self._real.literal(node.value[0])
            if len(text) < _PLACE:
                return text
        known = self._tables.setdefault(node.width, {})
        return f"{_short(node.width)}[{known.setdefault(node.value, len(known))}]"

    def text(self, types: Mapping[int, str]) -> str:
        """Return the C definitions of the tables and of their short names; ``types`` maps vector width → C type."""
        lines = []
        for width, known in sorted(self._tables.items()):
            rows = [", ".join(self._real.plain(v) for v in value) for value in known]
            if width > 1:
                rows = ["{" + row + "}" for row in rows]
            body = ",\n".join(f"  {row}" for row in rows)
            name = f"{self._prefix}_{_short(width).lower()}"
            lines.append(f"{self._qualifiers} {types[width]} {name}[{len(known)}] = {{\n{body}\n}};")
            lines.append(f"#define {_short(width)} {name}")
        return "\n".join([*lines, ""])


def _short(width: int) -> str:
    return f"K{width if width > 1 else ''}"


class Emitter:
    """C code of the blocks of one layout.

    The names of blocks begin with ``prefix``.  ``types`` maps a vector width to its C type.  ``size`` is the size in
    bytes of the type for a single value (width 1); by default, the size of ``real``.  ``work`` is the name of the C
    structure with inputs and work arrays.  ``work`` is empty if the inputs are separate arguments.
    """

    def __init__(
        self,
        layout: Layout,
        prefix: str,
        real: Real,
        types: Mapping[int, str],
        constants: Constants,
        size: int = 0,
        work: str = "",
    ) -> None:
        self.layout, self._prefix, self._real, self._types = layout, prefix, real, types
        self._constants, self._size, self._work = constants, size or real.size, work
        self._graph = layout.graph
        at = {k: number for number, block in enumerate(layout.blocks) for k in block.nodes}
        # Nodes that need a local variable, because another statement of the same block uses them.
        self._reused: set[int] = set()
        for k, number in at.items():
            waiting = list(self._graph.nodes[k].operands)
            while waiting:
                a = waiting.pop()
                a = self._graph.nodes[a].args[0] if self._graph.nodes[a].op == "lane" else a
                if a in layout.inlined:
                    waiting += self._graph.nodes[a].operands
                elif at.get(a) == number:
                    self._reused.add(a)
        self.blocks = [self._block(number, block) for number, block in enumerate(layout.blocks)]

    def output(self, k: int, work: str = "m.") -> str:
        """Return a C expression for the value of node ``k``, valid after the calls of the blocks."""
        node = self._graph.nodes[k]
        if node.op == "const":
            return self._real.literal(node.value[0])
        if node.op == "lane":
            return f"{self.output(node.args[0], work)}[{node.args[1]}]"
        if node.op == "in":
            return f"{work if self._work else ''}{self._graph.inputs[node.args[0]]}[{node.args[1]}]"
        if k in self.layout.trig:
            return f"{work}{'c' if node.op == COSINE else 's'}[{self.layout.trig[k]}]"
        return self._slot(k) if k in self.layout.shared else f"{work}{self._slot(k)}"

    def _block(self, number: int, block: Block) -> BlockText:
        names: dict[int, str] = {}
        lines: list[str] = []
        for k in block.nodes:
            node = self._graph.nodes[k]
            text = self._expression(k, number, names, lines, top=True)
            names[k] = f"v{len(names)}"
            kept = f"{self._slot(k)}=" if k in self.layout.slots else ""
            if kept and k not in self._reused:
                lines.append(f"{kept}{text};")
            elif node.op == "gather":
                lines.append(f"{self._types[node.width]} {names[k]}={text};")
                lines += [f"{kept}{names[k]};"] if kept else []
            else:
                lines.append(f"{self._types[node.width]} {names[k]}={kept}{text};")
        body = "\n".join(lines)
        used = set(re.findall(r"\b([a-z]\w*)\[|\((\w) \+", body))
        present = {name for pair in used for name in pair if name}
        scalar = self._types[1]
        parameters, arguments = [], []
        for name in self._graph.inputs:
            if name in present:
                parameters.append(f"const {scalar} *{name}")
                arguments.append(f"{self._work}.{name}" if self._work else name)
        for name in _SHARED:
            if name in present:
                constant = "const " if name in "sc" else ""
                kind = self._types[1 if name == "wx" else int(name[1:] or 1)]
                parameters.append(f"{constant}{kind} *{name}")
                arguments.append(name if name == "wx" else f"{self._work or 'm'}.{name}")
        title = f"{self._prefix}_block{number}"
        local = sum(self._graph.nodes[k].width for k in names) * self._size
        return BlockText(
            f"APART void {title}({', '.join(parameters)})\n{{\n{body}\n}}\n",
            f"{title}({', '.join(arguments)});",
            local,
            _HALVES * self._vector_bytes(block),
        )

    def _vector_bytes(self, block: Block) -> int:
        """Return the total size of all vectors that a block computes, including vectors within statements, bytes."""
        total, waiting = 0, list(block.nodes)
        while waiting:
            node = self._graph.nodes[waiting.pop()]
            total += node.width * self._size if node.width > 1 else 0
            waiting += [a for a in node.operands if a in self.layout.inlined]
        return total

    def _expression(self, k: int, number: int, names: dict[int, str], lines: list[str], *, top: bool = False) -> str:
        """Return a C expression for node ``k``: a variable, an array element, or the operation itself.

        An operation is in parentheses, except as the right side of a statement (``top``).
        """
        node = self._graph.nodes[k]
        if not top and k in names:
            return names[k]
        if k in self.layout.leaves:
            return self._leaf(k, node, number, names, lines)
        if not top and k not in self.layout.inlined:
            return self._slot(k)
        operands = [self._expression(a, number, names, lines) for a in node.operands]
        if node.op == "gather":
            return "{" + ", ".join(operands) + "}"
        if node.op in ("+", "-", "*"):
            text = f"{operands[0]}{node.op}{operands[1]}"
        elif node.op == "neg":
            text = f"-{operands[0]}"
        elif node.op == "inv":
            text = self._real.spelled("1.0") + f"/{operands[0]}"
        else:
            return self._real.spelled(node.op).format(*operands)
        return text if top else f"({text})"

    def _leaf(self, k: int, node: Node, number: int, names: dict[int, str], lines: list[str]) -> str:
        if node.op == "const":
            return self._constants.place(node)
        if node.op == "in":
            return f"{self._graph.inputs[node.args[0]]}[{node.args[1]}]"
        if node.op == "lane":
            return f"{self._expression(node.args[0], number, names, lines)}[{node.args[1]}]"
        array = "c" if node.op == COSINE else "s"
        if node.width == 1:
            return f"{array}[{self.layout.trig[k]}]"
        names[k] = f"v{len(names)}"
        kind = self._types[node.width]
        lines.append(f"const {kind} {names[k]} = *(const {kind}u *)({array} + {self.layout.trig[k]});")
        return names[k]

    def _slot(self, k: int) -> str:
        if k in self.layout.shared:
            return f"wx[{self.layout.slots[k]}*{LANES}]"
        width = self._graph.nodes[k].width
        return f"w{width if width > 1 else ''}[{self.layout.slots[k]}]"
