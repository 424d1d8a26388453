"""CasADi's instruction list as a graph of operations that a C compiler can be given in any order and grouping."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca

from impact_posture.errors import CompilerError

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


@dataclass(frozen=True)
class Node:
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
        """Return the number of the node; arithmetic on constants becomes a constant."""
        operands = [self.nodes[a] for a in node.operands]
        if node.op in ARITHMETIC and all(o.op == "const" for o in operands):
            width = max(o.width for o in operands)
            lanes = [[o.value[k if o.width > 1 else 0] for o in operands] for k in range(width)]
            return self.constant(*[_COMPUTE[node.op](*numbers) for numbers in lanes])
        if node.op in _COMMUTE:
            node = Node(node.op, tuple(sorted(node.args)), node.width)
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return self._known[node]

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


_COMPUTE: dict[str, Callable[..., float]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b if b else math.copysign(math.inf, b) * a,
    "neg": lambda a: -a,
    "inv": lambda a: 1.0 / a if a else math.copysign(math.inf, a),
}


def graph_of(function: ca.Function) -> Graph:
    """Return the operations of an SX function, with one reciprocal for each number that divides several.

    Sparse outputs become dense.

    Raises:
        CompilerError: An operation has no C form.
    """
    inputs = function.sx_in()
    outputs = [ca.densify(value) for value in function.call(inputs)]
    function = ca.Function("dense", inputs, outputs, function.name_in(), function.name_out())
    graph = Graph(tuple(function.name_in()))
    graph.outputs = {name: [graph.constant(0.0)] * function.numel_out(name) for name in function.name_out()}
    divisors = _divisors(function)
    held: dict[int, int] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        source, target = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            graph.outputs[function.name_out(target[0])][target[1]] = held[source[0]]
        elif operation == ca.OP_CONST:
            held[target[0]] = graph.constant(function.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            held[target[0]] = graph.add(Node("in", (source[0], source[1])))
        else:
            held[target[0]] = _operation(graph, operation, [held[s] for s in source], divisors[k])
    return graph


def _operation(graph: Graph, operation: int, operands: list[int], divided: int) -> int:
    first = operands[0]
    if operation == ca.OP_ASSIGN:
        return first
    if operation == ca.OP_DIV and divided > 1:
        return graph.add(Node("*", (first, graph.add(Node("inv", (operands[1],))))))
    if operation in _BINARY:
        return graph.add(Node(_BINARY[operation], (first, operands[1])))
    unary = {
        ca.OP_NEG: Node("neg", (first,)),
        ca.OP_INV: Node("inv", (first,)),
        ca.OP_SQ: Node("*", (first, first)),
        ca.OP_TWICE: Node("+", (first, first)),
    }
    if operation in unary:
        return graph.add(unary[operation])
    if operation in CALLS:
        text = CALLS[operation]
        return graph.add(Node(text, tuple(operands[: 2 if "{1}" in text else 1])))
    raise CompilerError(
        f"CasADi operation {operation} has no C form", where="codegen", hint="add it to codegen/graph.py"
    )


def _divisors(function: ca.Function) -> list[int]:
    """For each instruction that divides, how many divide by the same number."""
    made: dict[int, int] = {}
    by: dict[int, int] = {}
    for k in range(function.n_instructions()):
        operation, source = function.instruction_id(k), function.instruction_input(k)
        if operation in (ca.OP_DIV, ca.OP_INV):
            by[k] = made[source[1 if operation == ca.OP_DIV else 0]]
        if operation != ca.OP_OUTPUT:
            made[function.instruction_output(k)[0]] = k
    counts = Counter(by.values())
    return [counts[by[k]] if k in by else 0 for k in range(function.n_instructions())]
