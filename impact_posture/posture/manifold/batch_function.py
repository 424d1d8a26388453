"""Evaluate a CasADi function at many postures at once.

CasADi evaluates one posture after another.  For a batch, a loop in C runs each operation of the function on a block
of postures.  For 512 postures, the loop takes about a twentieth of the time of CasADi.  Without a compiler, NumPy
runs each operation on all postures, in about an eighth of the time of CasADi.  CasADi, the loop in C and NumPy give
equal results.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.errors import CompilerError, OutputError, SpecError
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import building, cache_folder, is_cached, load_library, source_key
from impact_posture.system.toolchain import require_compiler, run_compiler

# Number of postures that NumPy evaluates together.  With fewer postures, the calls of NumPy take most of the time.
_WIDTH = 512
# Number of postures in a block of the loop in C.  In a smaller block, branching to the code of each operation would
# take most of the time.
_LANES = 64
# Below these numbers of postures, CasADi is faster than the loop in C, and than NumPy.
_FEW, _SMALL = 3, 64


def _if_else_zero(condition: Array, value: Array, out: Array) -> None:
    np.copyto(out, np.where(condition != 0, value, 0.0))


def _twice(value: Array, out: Array) -> None:
    np.add(value, value, out)


# For each operation, the function of NumPy and the expression in C, whose arguments are a and b.
_OPERATIONS: dict[int, tuple[Callable[..., Any], str]] = {
    ca.OP_ASSIGN: (np.positive, "a"), ca.OP_ADD: (np.add, "a + b"), ca.OP_SUB: (np.subtract, "a - b"),
    ca.OP_MUL: (np.multiply, "a * b"), ca.OP_DIV: (np.divide, "a / b"), ca.OP_NEG: (np.negative, "-a"),
    ca.OP_INV: (np.reciprocal, "1 / a"), ca.OP_SQ: (np.square, "a * a"), ca.OP_TWICE: (_twice, "a + a"),
    ca.OP_SQRT: (np.sqrt, "sqrt(a)"), ca.OP_POW: (np.power, "pow(a, b)"), ca.OP_CONSTPOW: (np.power, "pow(a, b)"),
    ca.OP_EXP: (np.exp, "exp(a)"), ca.OP_LOG: (np.log, "log(a)"), ca.OP_SIN: (np.sin, "sin(a)"),
    ca.OP_COS: (np.cos, "cos(a)"), ca.OP_TAN: (np.tan, "tan(a)"), ca.OP_ASIN: (np.arcsin, "asin(a)"),
    ca.OP_ACOS: (np.arccos, "acos(a)"), ca.OP_ATAN: (np.arctan, "atan(a)"), ca.OP_ATAN2: (np.arctan2, "atan2(a, b)"),
    ca.OP_HYPOT: (np.hypot, "hypot(a, b)"), ca.OP_FABS: (np.absolute, "fabs(a)"),
    ca.OP_SIGN: (np.sign, "a > 0 ? 1 : a < 0 ? -1 : a"), ca.OP_FMIN: (np.fmin, "fmin(a, b)"),
    ca.OP_FMAX: (np.fmax, "fmax(a, b)"), ca.OP_LT: (np.less, "a < b"), ca.OP_LE: (np.less_equal, "a <= b"),
    ca.OP_EQ: (np.equal, "a == b"), ca.OP_NE: (np.not_equal, "a != b"), ca.OP_NOT: (np.logical_not, "!a"),
    ca.OP_AND: (np.logical_and, "a && b"), ca.OP_OR: (np.logical_or, "a || b"),
    ca.OP_IF_ELSE_ZERO: (_if_else_zero, "a != 0 ? b : 0"),
}  # fmt: skip

# The loop in C.  An operation is four integers: code, two arguments and target.  Arguments and target are registers,
# constants, or entries of the inputs x and the outputs y of a posture.
_LOOP = """#include <math.h>
#define REGISTER(n) (registers + LANES * o[n])
void run(const int *operations, int count, const double *constants, const double *x, int nx, double *y, int ny,
         int postures, double *registers)
{
    for (int first = 0; first < postures; first += LANES) {
        const int width = postures - first < LANES ? postures - first : LANES;
        for (const int *o = operations; o < operations + 4 * count; o += 4) {
            switch (o[0]) {
            case CONSTANT: for (int k = 0; k < LANES; ++k) REGISTER(3)[k] = constants[o[1]]; break;
            case INPUT: for (int k = 0; k < width; ++k) REGISTER(3)[k] = x[(first + k) * nx + o[1]]; break;
            case OUTPUT: for (int k = 0; k < width; ++k) y[(first + k) * ny + o[3]] = REGISTER(1)[k]; break;
OPERATIONS
            }
        }
    }
}
"""
_OPERATION = """            case {}: {{
                const double *u = REGISTER(1), *v = REGISTER(2);
                double *w = REGISTER(3);
                _Pragma("GCC ivdep") for (int k = 0; k < LANES; ++k) {{
                    const double a = u[k], b = v[k];
                    (void)b;
                    w[k] = {};
                }}
                break;
            }}"""


@cache
def _compiled_loop() -> Callable[..., None] | None:
    """Return the loop in C, which is built once and cached; ``None`` if the build fails."""
    cases = (_OPERATION.format(code, expression) for code, (_, expression) in _OPERATIONS.items())
    source = _LOOP.replace("OPERATIONS", "\n".join(cases))
    numbers = {"LANES": _LANES, "CONSTANT": ca.OP_CONST, "INPUT": ca.OP_INPUT, "OUTPUT": ca.OP_OUTPUT}
    # Without fused multiplications and additions, the results equal the results of NumPy.
    flags = ["-O2", "-fPIC", "-ffp-contract=off", "-fno-math-errno", *(f"-D{k}={n}" for k, n in numbers.items())]
    try:
        library = cache_folder() / f"{source_key([source, *flags, platform.system(), platform.machine()])}.so"
        if not is_cached(library):
            compiler = require_compiler("search")
            with building(library) as folder:
                (folder / "batch.c").write_text(source, encoding="utf-8")
                run_compiler([*compiler, *flags, "-shared", "batch.c", "-o", library.name, "-lm"], folder)
        run = load_library(library).run
    except (CompilerError, OutputError, SpecError):
        return None
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    run.argtypes = [pointer, integer, pointer, pointer, integer, pointer, integer, integer, pointer]
    run.restype = None
    return run


class _Program(NamedTuple):
    """The operations of a function as calls of NumPy, and the arrays of its inputs and outputs, one row each."""

    inputs: list[Array]
    outputs: list[Array]
    calls: list[tuple[Callable[..., Any], tuple[Array, ...]]]


class _LoopProgram(NamedTuple):
    """The operations of a function for the loop in C, shape (N, 4), with constants and registers."""

    operations: NDArray[np.int32]
    constants: Array
    registers: Array


class BatchFunction:
    """A function of a posture, given by expressions, that is called on the rows of arrays."""

    def __init__(self, inputs: list[ca.SX], outputs: list[ca.SX]) -> None:
        self._expressions = inputs, [ca.densify(output) for output in outputs]

    def __call__(self, *inputs: Array) -> list[Array]:
        """Return the outputs at each row of the inputs, shape (N, rows, columns)."""
        count, run = len(inputs[0]), _compiled_loop()
        if count < (_FEW if run else _SMALL) or self._operations is None:
            return self._one_by_one(inputs)
        if run:
            return self._in_blocks(run, np.concatenate(inputs, axis=1))
        parts = [self._together([x[k : k + _WIDTH] for x in inputs]) for k in range(0, count, _WIDTH)]
        return [np.concatenate(pieces) for pieces in zip(*parts, strict=True)]

    def _one_by_one(self, inputs: tuple[Array, ...]) -> list[Array]:
        count = len(inputs[0])
        if not count:
            return [np.zeros((0, *shape)) for shape in self._shapes]
        outputs = self._function.call([ca.DM(np.ascontiguousarray(value.T)) for value in inputs])
        return [
            np.asarray(value, dtype=float).reshape(shape[0], count, shape[1]).transpose(1, 0, 2)
            for value, shape in zip(outputs, self._shapes, strict=True)
        ]

    def _in_blocks(self, run: Callable[..., None], x: Array) -> list[Array]:
        (operations, constants, registers), ends = self._loop_program, self._ends
        x, y = np.ascontiguousarray(x, dtype=float), np.empty((len(x), ends[-1]))
        run(
            operations.ctypes.data, len(operations), constants.ctypes.data, x.ctypes.data, x.shape[1],
            y.ctypes.data, y.shape[1], len(x), registers.ctypes.data,
        )  # fmt: skip
        return [
            np.ascontiguousarray(piece).reshape(len(x), *shape)
            for piece, shape in zip(np.split(y, ends[:-1], axis=1), self._shapes, strict=True)
        ]

    def _together(self, inputs: list[Array]) -> list[Array]:
        count, program = len(inputs[0]), self._program
        for row, value in zip(program.inputs, inputs, strict=True):
            row[:, :count] = value.T
            # The remaining columns repeat the first posture, because the operations may fail for arbitrary numbers.
            row[:, count:] = value[:1].T
        with np.errstate(all="ignore"):
            for operation, arguments in program.calls:
                operation(*arguments)
        return [
            row[:, :count].T.reshape(count, shape[1], shape[0]).transpose(0, 2, 1).copy()
            for row, shape in zip(program.outputs, self._shapes, strict=True)
        ]

    @cached_property
    def _function(self) -> ca.Function:
        return ca.Function("batch", *self._expressions, {"cse": True})

    @cached_property
    def _shapes(self) -> list[tuple[int, int]]:
        return [output.shape for output in self._expressions[1]]

    @cached_property
    def _ends(self) -> list[int]:
        """For each output, the number of entries of this output and of the outputs before it."""
        return [int(end) for end in np.cumsum([rows * columns for rows, columns in self._shapes])]

    @cached_property
    def _operations(self) -> list[tuple[int, list[int], list[int], float]] | None:
        """Code, inputs, outputs and constant of each operation; ``None`` if NumPy lacks an operation."""
        function, operations = self._function, list[tuple[int, list[int], list[int], float]]()
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            if code not in _OPERATIONS and code not in (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT):
                return None
            constant = function.instruction_constant(k) if code == ca.OP_CONST else 0.0
            operations.append((code, function.instruction_input(k), function.instruction_output(k), constant))
        return operations

    @cached_property
    def _loop_program(self) -> _LoopProgram:
        function, operations = self._function, self._operations
        assert operations is not None  # noqa: S101 (narrows a type)
        before = np.cumsum([0, *(function.nnz_in(k) for k in range(function.n_in()))]).tolist()
        rows, constants = list[tuple[int, int, int, int]](), list[float]()
        for code, sources, targets, constant in operations:
            if code == ca.OP_CONST:
                rows.append((code, len(constants), 0, targets[0]))
                constants.append(constant)
            elif code == ca.OP_INPUT:
                rows.append((code, before[sources[0]] + sources[1], 0, targets[0]))
            elif code == ca.OP_OUTPUT:
                # CasADi counts the entries by columns, NumPy by rows.
                height, width = self._shapes[targets[0]]
                column, row = divmod(targets[1], height)
                rows.append((code, sources[0], 0, self._ends[targets[0]] - height * width + row * width + column))
            else:
                rows.append((code, sources[0], sources[-1], targets[0]))
        registers = np.zeros((function.sz_w(), _LANES))
        return _LoopProgram(np.array(rows, dtype=np.int32).reshape(-1, 4), np.array(constants), registers)

    @cached_property
    def _program(self) -> _Program:
        function, operations = self._function, self._operations
        assert operations is not None  # noqa: S101 (narrows a type)
        inputs = [np.zeros((function.nnz_in(k), _WIDTH)) for k in range(function.n_in())]
        outputs = [np.zeros((function.nnz_out(k), _WIDTH)) for k in range(function.n_out())]
        calls, own = list[tuple[Callable[..., Any], tuple[Array, ...]]](), list(np.zeros((function.sz_w(), _WIDTH)))
        # For each register of the function, the array that currently contains its value.
        at, constants = [*own], dict[float, Array]()
        for code, sources, targets, constant in operations:
            if code == ca.OP_CONST:
                at[targets[0]] = constants.setdefault(constant, np.full(_WIDTH, constant))
            elif code == ca.OP_INPUT:
                at[targets[0]] = inputs[sources[0]][sources[1]]
            elif code == ca.OP_OUTPUT:
                calls.append((np.copyto, (outputs[targets[0]][targets[1]], at[sources[0]])))
            else:
                arguments, register = [at[source] for source in sources], targets[0]
                at[register] = own[register]
                calls.append((_OPERATIONS[code][0], (*arguments, own[register])))
        return _Program(inputs, outputs, calls)
