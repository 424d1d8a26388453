"""The instructions of a CasADi function as a graph of operations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import casadi as ca

from impact_posture.errors import CompilerError

# Operations that C can apply to vectors.  A division becomes a product with a reciprocal ("inv"), because several
# divisions by the same number share one reciprocal.
ARITHMETIC = frozenset({"+", "-", "*", "neg", "inv"})
_COMMUTE = frozenset({"+", "*"})
# Functions with the same name in C and in CasADi.  The first tuple lists functions of one argument.
_OF_ONE = ("exp", "log", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "tanh", "fabs")
_OF_TWO = ("pow", "atan2", "hypot", "fmin", "fmax")
# CasADi operation → C expression, for all other operations.  Every operand is a name or is in parentheses.
CALLS = {
    **{getattr(ca, f"OP_{name.upper()}"): f"{name}({{0}})" for name in _OF_ONE},
    **{getattr(ca, f"OP_{name.upper()}"): f"{name}({{0}}, {{1}})" for name in _OF_TWO},
    ca.OP_CONSTPOW: "pow({0}, {1})",
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
# CasADi operation → binary operation.  A square x*x and a double x+x use the same operand twice.
_PAIRS = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_SQ: "*", ca.OP_TWICE: "+"}
_SINGLE = {ca.OP_NEG: "neg", ca.OP_INV: "inv"}
SINE, COSINE = CALLS[ca.OP_SIN], CALLS[ca.OP_COS]


class Node(NamedTuple):
    """One operation of a graph.

    Attributes:
        op: ``const`` (constant), ``in`` (entry of an input), ``lane`` (entry of a vector), ``gather`` (vector from
            single numbers), an operation of :data:`ARITHMETIC`, or a C expression of :data:`CALLS`.
        args: Numbers of the operand nodes.  For ``in``: number of the input, and index in the input.  For ``lane``:
            number of the vector node, and index in the vector.
        width: Number of lanes of a vector; 1 for a single number.
        value: For ``const``, one value per lane, or one value for all lanes.
    """

    op: str
    args: tuple[int, ...] = ()
    width: int = 1
    value: tuple[float, ...] = ()

    @property
    def operands(self) -> tuple[int, ...]:
        """The entries of :attr:`args` that are numbers of nodes."""
        return () if self.op in ("const", "in") else self.args[:1] if self.op == "lane" else self.args


@dataclass
class Graph:
    """List of operations in which each operation comes after its operands, and no operation occurs twice.

    Attributes:
        inputs: Names of the inputs of the graph.
        nodes: The operations.  The number of a node is its index in this list.
        outputs: Output name → numbers of the nodes of its entries, column by column.
    """

    inputs: tuple[str, ...]
    nodes: list[Node] = field(default_factory=list)
    outputs: dict[str, list[int]] = field(default_factory=dict)
    _known: dict[Node, int] = field(default_factory=dict)

    @cached_property
    def depths(self) -> list[int]:
        """Number of arithmetic operations on the longest chain that ends at each node, for a complete graph."""
        depths: list[int] = []
        for node in self.nodes:
            depths.append((node.op in ARITHMETIC) + max((depths[a] for a in node.operands), default=0))
        return depths

    def add(self, node: Node) -> int:
        """Return the number of a node, and add the node if it is new.

        If all operands of an arithmetic operation are constants, the result is a constant node instead.
        """
        if node.op in ARITHMETIC and all(self.nodes[a].op == "const" for a in node.args):
            operands = [self.nodes[a] for a in node.args]
            width = max(o.width for o in operands)
            lanes = [[o.value[k if o.width > 1 else 0] for o in operands] for k in range(width)]
            return self.constant(*[_COMPUTE[node.op](*numbers) for numbers in lanes])
        if node.op in _COMMUTE:
            node = Node(node.op, tuple(sorted(node.args)), node.width)
        number = self._known.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
        return number

    def constant(self, *value: float) -> int:
        """Return the number of a constant node; a vector of equal numbers becomes a single number."""
        same = len(set(value)) == 1
        return self.add(Node("const", (), 1 if same else len(value), value[:1] if same else value))

    def element(self, node: int, lane: int) -> int:
        """Return the number of the node for one lane of a vector."""
        vector = self.nodes[node]
        if vector.op == "const":
            return self.constant(vector.value[lane if vector.width > 1 else 0])
        return node if vector.width == 1 else self.add(Node("lane", (node, lane)))


_COMPUTE: dict[str, Callable[..., float]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "neg": lambda a: -a,
    "inv": lambda a: 1.0 / a if a else math.copysign(math.inf, a),
}


def graph_of(function: ca.Function) -> Graph:
    """Return the operations of an SX function as a graph.  Sparse outputs become dense.

    Raises:
        CompilerError: An operation of the function cannot be written in C.
    """
    inputs = function.sx_in()
    outputs = [ca.densify(value) for value in function.call(inputs)]
    function = ca.Function("dense", inputs, outputs, function.name_in(), function.name_out())
    graph = Graph(tuple(function.name_in()))
    graph.outputs = {name: [graph.constant(0.0)] * function.numel_out(name) for name in function.name_out()}
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
            held[target[0]] = _operation(graph, operation, [held[s] for s in source])
    return graph


def _operation(graph: Graph, operation: int, operands: list[int]) -> int:
    a, b = operands[0], operands[-1]
    if operation == ca.OP_ASSIGN:
        return a
    if operation == ca.OP_DIV:
        return graph.add(Node("*", (a, graph.add(Node("inv", (b,))))))
    if operation in _PAIRS:
        return graph.add(Node(_PAIRS[operation], (a, b)))
    if operation in _SINGLE:
        return graph.add(Node(_SINGLE[operation], (a,)))
    if operation in CALLS:
        text = CALLS[operation]
        return graph.add(Node(text, (a, b) if "{1}" in text else (a,)))
    hint = "add it to codegen/expression_graph.py"
    raise CompilerError(f"CasADi operation {operation} cannot be written in C", where="codegen", hint=hint)
