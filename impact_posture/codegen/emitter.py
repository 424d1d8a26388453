"""Straight-line C99 from CasADi's instruction list: one local variable a line, no work array, nothing static.

CasADi's own generator addresses its inputs and a work vector through pointers, takes a memory handle, and brings its
runtime along; none of it is needed for an expression graph, and compilers keep plain locals in registers better.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from impact_posture.errors import CompilerError

_MATH = re.compile(r"\b(exp|log|pow|sqrt|a?sin|a?cos|a?tan|atan2|tanh|hypot|fabs|fmin|fmax)\(")
_DECLARATION = re.compile(r"^  (?:const )?(?:double|float) \w+ =", re.MULTILINE)


@dataclass(frozen=True)
class Real:
    """The C type that an export computes in.

    Attributes:
        name: ``double`` or ``float``.
        size: Bytes of one.
        unit_tolerance: How far the norm of a quaternion may be from one.
    """

    name: str
    size: int
    unit_tolerance: float

    @property
    def dtype(self) -> np.dtype[np.floating[Any]]:
        """The same type in numpy, whose ``float`` is a double."""
        return np.dtype(np.float64 if self.name == "double" else np.float32)

    def rounded(self, values: ArrayLike) -> NDArray[np.float64]:
        """The nearest numbers of this type, as doubles."""
        return np.array(values, dtype=self.dtype).astype(np.float64)

    def literal(self, value: float) -> str:
        """A literal that reads back as the nearest number of this type; negative ones in parentheses."""
        if self.name == "double" or not math.isfinite(value):
            return c_double(value)
        with np.errstate(over="ignore", under="ignore"):
            nearest = np.float32(value)
        text = c_double(float(str(nearest)))
        if not np.isfinite(nearest):
            return text
        return f"{text[:-1]}f)" if text.endswith(")") else f"{text}f"

    def spelled(self, operation: str) -> str:
        """An operation's C, written for doubles, in this type: ``sinf`` for ``sin``, ``1.0f`` for ``1.0``."""
        if self.name == "double":
            return operation
        text = _MATH.sub(r"\1f(", operation).replace("(double)", "(float)")
        return re.sub(r"\b\d+\.\d+", r"\g<0>f", text)


DOUBLE = Real("double", 8, 1e-6)
FLOAT = Real("float", 4, 1e-5)

# Operands are names or literals in parentheses where they are negative: none of these needs more parentheses.
_OPERATIONS = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_INV: "1.0 / {0}",
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
    ca.OP_IF_ELSE_ZERO: "{0} != 0.0 ? {1} : 0.0",
}


def c_double(value: float) -> str:
    """A double literal that reads back exactly; negative ones in parentheses."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def c_vector(values: Sequence[float], indent: str = "  ", real: Real = DOUBLE) -> str:
    """A brace initializer, four numbers a line."""
    texts = [real.literal(float(v)).strip("()") for v in values]
    rows = [", ".join(texts[k : k + 4]) for k in range(0, len(texts), 4)]
    return "{\n" + ",\n".join(f"{indent}  {row}" for row in rows) + f"\n{indent}}}"


def count_locals(text: str) -> int:
    """Local numbers that the functions of :func:`emit_function` declare: what their frames hold at most."""
    return len(_DECLARATION.findall(text))


def emit_function(name: str, function: ca.Function, real: Real = DOUBLE) -> str:
    """``static void name(const double *input, ..., double *output, ...)`` with the values of an SX function.

    Parameters have the function's own input and output names; outputs are dense, column by column.  Every input is
    read before an output is written, so an output may overlap an input.

    Args:
        name: Name in C.
        function: An SX function whose inputs are dense.
        real: The C type of every number.

    Raises:
        CompilerError: An operation that has no C here.
    """
    function = _dense(function)
    parameters = [f"const {real.name} *{v}" for v in function.name_in()]
    parameters += [f"{real.name} *{v}" for v in function.name_out()]
    loads, body, read = _statements(function, real)
    unread = [f"(void){v};" for v in function.name_in() if v not in read]
    lines = [f"  {line}" for line in (*unread, *loads, *body)]
    return "\n".join([f"static void {name}({', '.join(parameters)})", "{", *lines, "}"]) + "\n"


def _dense(function: ca.Function) -> ca.Function:
    inputs = function.sx_in()
    outputs = [ca.densify(value) for value in function.call(inputs)]
    return ca.Function("dense", inputs, outputs, function.name_in(), function.name_out())


def _statements(function: ca.Function, real: Real) -> tuple[list[str], list[str], set[str]]:
    """Loads of inputs, the rest of the body, and the names of the inputs that are read."""
    loads: dict[tuple[str, int], str] = {}
    body: list[str] = []
    # What a work slot holds is its variable's name, or the constant or input that was put there.
    held: dict[int, str] = {}
    declared: set[int] = set()
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        source, target = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_CONST:
            held[target[0]] = real.literal(function.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            key = (function.name_in(source[0]), int(source[1]))
            loads[key] = held[target[0]] = f"{key[0]}{key[1]}"
        elif operation == ca.OP_OUTPUT:
            body.append(f"{function.name_out(target[0])}[{target[1]}] = {held[source[0]]};")
        elif operation in _OPERATIONS:
            value = real.spelled(_OPERATIONS[operation]).format(*[held[s] for s in source])
            slot = target[0]
            body.append(f"{'' if slot in declared else f'{real.name} '}w{slot} = {value};")
            declared.add(slot)
            held[slot] = f"w{slot}"
        else:
            raise CompilerError(
                f"CasADi operation {operation} has no C form", where="codegen", mend="add it to codegen/emitter.py"
            )
    lines = [f"const {real.name} {text} = {key[0]}[{key[1]}];" for key, text in sorted(loads.items())]
    return lines, body, {key[0] for key in loads}
