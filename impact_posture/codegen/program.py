"""CasADi's instruction list as a graph of operations that a C compiler can be given in any order and grouping."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import casadi as ca

from impact_posture.errors import CompilerError

# What CasADi calls an operation, the places that it reads, and those that it writes.
_Instruction = tuple[int, Sequence[int], Sequence[int]]
# Operations that vectors have in C.
ARITHMETIC = frozenset({"+", "-", "*", "/", "neg", "inv"})
_COMMUTE = frozenset({"+", "*"})
_BINARY = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
# The rest, in C's terms: operands are names or stand in parentheses.
CALLS = {
    ca.OP_EXP: "exp({0})",
    ca.OP_LOG: "log({0})",
    ca.OP_POW: "pow({0}, {1})",
    ca.OP_CONSTPOW: "pow({0}, {1})",
    ca.OP_SQRT: "sqrt({0})",
    ca.OP_SIN: "sin({0})",
    ca.OP_COS: "cos({0})",
    ca.OP_TAN: "tan({0})",
    ca.OP_ASIN: "asin({0})",
    ca.OP_ACOS: "acos({0})",
    ca.OP_ATAN: "atan({0})",
    ca.OP_ATAN2: "atan2({0}, {1})",
    ca.OP_TANH: "tanh({0})",
    ca.OP_HYPOT: "hypot({0}, {1})",
    ca.OP_FABS: "fabs({0})",
    ca.OP_FMIN: "fmin({0}, {1})",
    ca.OP_FMAX: "fmax({0}, {1})",
    ca.OP_SIGN: "(double)(({0} > 0.0) - ({0} < 0.0))",
    ca.OP_LT: "(double)({0} < {1})",
    ca.OP_LE: "(double)({0} <= {1})",
    ca.OP_EQ: "(double)({0} == {1})",
    ca.OP_NE: "(double)({0} != {1})",
    ca.OP_NOT: "(double)({0} == 0.0)",
    ca.OP_AND: "(double)({0} != 0.0 && {1} != 0.0)",
    ca.OP_OR: "(double)({0} != 0.0 || {1} != 0.0)",
    ca.OP_IF_ELSE_ZERO: "({0} != 0.0 ? {1} : 0.0)",
}
SINE, COSINE = CALLS[ca.OP_SIN], CALLS[ca.OP_COS]


class Node(NamedTuple):
    """One operation.

    Attributes:
        op: ``const``, ``in``, ``lane``, one of :data:`ARITHMETIC`, or a C expression out of :data:`CALLS`.
        args: Numbers of the operands; of ``in`` its name's number and index; of ``lane`` the vector and which lane.
        width: Numbers that it holds: 1, or the lanes of a vector.
        value: Of ``const``: its numbers.
    """

    op: str
    args: tuple[int, ...] = ()
    width: int = 1
    value: tuple[float, ...] = ()

    @property
    def operands(self) -> tuple[int, ...]:
        """The nodes that it needs."""
        return () if self.op in ("const", "in") else self.args[:1] if self.op == "lane" else self.args


@dataclass
class Graph:
    """Operations in an order in which every operand comes first; equal ones exist once.

    Attributes:
        inputs: Names of the inputs.
        nodes: The operations.
        outputs: Output name → the nodes of its entries, column by column.
    """

    inputs: tuple[str, ...]
    nodes: list[Node] = field(default_factory=list)
    outputs: dict[str, list[int]] = field(default_factory=dict)
    _known: dict[Node, int] = field(default_factory=dict)

    def add(self, node: Node) -> int:
        """Number of the node, simplified where its operands are constants."""
        if node.op in _COMMUTE and node.args[0] > node.args[1]:
            node = Node(node.op, node.args[::-1], node.width)
        simpler = self._simplified(node) if node.op in ARITHMETIC else None
        if isinstance(simpler, int):
            return simpler
        node = node if simpler is None else simpler
        number = self._known.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
        return number

    def constant(self, *value: float) -> int:
        """A number, or a vector of them; a vector of equal numbers is the number."""
        same = len(set(value)) == 1
        return self.add(Node("const", (), 1 if same else len(value), value[:1] if same else value))

    def element(self, node: int, lane: int) -> int:
        """One number of a vector."""
        found = self.nodes[node]
        if found.op == "const":
            return self.constant(found.value[lane if found.width > 1 else 0])
        return node if found.width == 1 else self.add(Node("lane", (node, lane)))

    def _simplified(self, node: Node) -> Node | int | None:
        operands = [self.nodes[a] for a in node.args]
        known = [o.op == "const" for o in operands]
        if not any(known):
            return operands[0].args[0] if node.op == "neg" and operands[0].op == "neg" else None
        if all(known):
            width = max(o.width for o in operands)
            lanes = [[o.value[k if o.width > 1 else 0] for o in operands] for k in range(width)]
            return self.constant(*[_COMPUTE[node.op](*numbers) for numbers in lanes])
        values = [o.value[0] if o.op == "const" and o.width == 1 else None for o in operands]
        (a, b), (x, y) = node.args, values
        fits = {k: self.nodes[k].width == node.width for k in (a, b)}
        if node.op == "*" and 0.0 in (x, y):
            return self.constant(0.0)
        rules: list[tuple[bool, Node | int]] = [
            (node.op in "+*" and x == (0.0 if node.op == "+" else 1.0) and fits[b], b),
            (node.op in "+-" and y == 0.0 and fits[a], a),
            (node.op in "*/" and y == 1.0 and fits[a], a),
            (node.op == "-" and x == 0.0, Node("neg", (b,), node.width)),
            (node.op == "*" and x == -1.0, Node("neg", (b,), node.width)),
            (node.op == "*" and y == -1.0, Node("neg", (a,), node.width)),
        ]
        return next((self.add(found) if isinstance(found, Node) else found for holds, found in rules if holds), None)


_COMPUTE: dict[str, Callable[..., float]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b if b else math.copysign(math.inf, b) * a,
    "neg": lambda a: -a,
    "inv": lambda a: 1.0 / a if a else math.copysign(math.inf, a),
}


def graph_of(function: ca.Function, parameters: Mapping[str, Sequence[float]] | None = None) -> Graph:
    """The operations of an SX function, one reciprocal for each number that several are divided by.

    Args:
        function: An SX function; its sparse outputs are taken as dense.
        parameters: Inputs that are constants, by name.

    Raises:
        CompilerError: An operation that has no C here.
    """
    function = _dense(function)
    names, constants = function.name_in(), dict(parameters or {})
    graph = Graph(tuple(names))
    instructions = [
        (function.instruction_id(k), function.instruction_input(k), function.instruction_output(k))
        for k in range(function.n_instructions())
    ]
    divisors = _divisors(instructions)
    held: dict[int, int] = {}
    for k, (operation, source, target) in enumerate(instructions):
        if operation == ca.OP_OUTPUT:
            name = function.name_out(target[0])
            entries = graph.outputs.setdefault(name, [graph.constant(0.0)] * function.numel_out(name))
            entries[target[1]] = held[source[0]]
            continue
        if operation == ca.OP_CONST:
            found = graph.constant(function.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            name = names[source[0]]
            known = constants.get(name)
            found = (
                graph.add(Node("in", (source[0], source[1]))) if known is None else graph.constant(known[source[1]])
            )
        else:
            found = _operation(graph, operation, [held[s] for s in source], divisors[k])
        held[target[0]] = found
    for name in function.name_out():
        graph.outputs.setdefault(name, [graph.constant(0.0)] * function.numel_out(name))
    return graph


def _operation(graph: Graph, operation: int, operands: list[int], divided: int) -> int:
    first = operands[0]
    if operation == ca.OP_ASSIGN:
        return first
    if operation == ca.OP_DIV and divided > 1:
        return graph.add(Node("*", (first, graph.add(Node("inv", (operands[1],))))))
    if operation in _BINARY:
        return graph.add(Node(_BINARY[operation], (first, operands[1])))
    if operation == ca.OP_NEG:
        return graph.add(Node("neg", (first,)))
    if operation == ca.OP_INV:
        return graph.add(Node("inv", (first,)))
    if operation in (ca.OP_SQ, ca.OP_TWICE):
        return graph.add(Node("*" if operation == ca.OP_SQ else "+", (first, first)))
    if operation in CALLS:
        text = CALLS[operation]
        return graph.add(Node(text, tuple(operands[: 2 if "{1}" in text else 1])))
    raise CompilerError(
        f"CasADi operation {operation} has no C form", where="codegen", hint="add it to codegen/program.py"
    )


def _divisors(instructions: Sequence[_Instruction]) -> list[int]:
    """For each instruction that divides, how many divide by the same number."""
    made: dict[int, int] = {}
    by: dict[int, int] = {}
    for k, (operation, source, target) in enumerate(instructions):
        if operation in (ca.OP_DIV, ca.OP_INV):
            by[k] = made[source[1 if operation == ca.OP_DIV else 0]]
        if operation != ca.OP_OUTPUT:
            made[target[0]] = k
    counts = Counter(by.values())
    return [counts[by[k]] if k in by else 0 for k in range(len(instructions))]


def _dense(function: ca.Function) -> ca.Function:
    inputs = function.sx_in()
    outputs = [ca.densify(value) for value in function.call(inputs)]
    return ca.Function("dense", inputs, outputs, function.name_in(), function.name_out())
