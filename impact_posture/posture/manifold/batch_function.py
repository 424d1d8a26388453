"""Evaluate a CasADi function at many postures at once.

CasADi evaluates one posture after another.  For a batch, NumPy runs each operation of the function on all postures
together, which takes about a fifth of the time for a batch of 256.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from impact_posture.system.arrays import Array

# Number of postures in each run of the operations.  With fewer postures, the calls of NumPy take most of the time.
_WIDTH = 256
# CasADi evaluates smaller batches in less time.
_SMALL = 64


def _if_else_zero(condition: Array, value: Array, out: Array) -> None:
    np.copyto(out, np.where(condition != 0, value, 0.0))


def _twice(value: Array, out: Array) -> None:
    np.add(value, value, out)


_OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: np.positive, ca.OP_ADD: np.add, ca.OP_SUB: np.subtract, ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide, ca.OP_NEG: np.negative, ca.OP_INV: np.reciprocal, ca.OP_SQ: np.square,
    ca.OP_TWICE: _twice, ca.OP_SQRT: np.sqrt, ca.OP_POW: np.power, ca.OP_CONSTPOW: np.power, ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log, ca.OP_SIN: np.sin, ca.OP_COS: np.cos, ca.OP_TAN: np.tan, ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos, ca.OP_ATAN: np.arctan, ca.OP_ATAN2: np.arctan2, ca.OP_HYPOT: np.hypot,
    ca.OP_FABS: np.absolute, ca.OP_SIGN: np.sign, ca.OP_FMIN: np.fmin, ca.OP_FMAX: np.fmax, ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal, ca.OP_EQ: np.equal, ca.OP_NE: np.not_equal, ca.OP_NOT: np.logical_not,
    ca.OP_AND: np.logical_and, ca.OP_OR: np.logical_or, ca.OP_IF_ELSE_ZERO: _if_else_zero,
}  # fmt: skip


class BatchFunction:
    """A function of a posture, given by expressions, that is called on the rows of arrays."""

    def __init__(self, inputs: list[ca.SX], outputs: list[ca.SX]) -> None:
        self._function = ca.Function("batch", inputs, [ca.densify(output) for output in outputs], {"cse": True})
        self._shapes = [self._function.size_out(k) for k in range(self._function.n_out())]

    def __call__(self, *inputs: Array) -> list[Array]:
        """Return the outputs at each row of the inputs, shape (N, rows, columns)."""
        count = len(inputs[0])
        if count < _SMALL or self._operations is None:
            return self._one_by_one(inputs)
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

    def _together(self, inputs: list[Array]) -> list[Array]:
        operations, count = self._operations, len(inputs[0])
        assert operations is not None  # noqa: S101 (narrows a type)
        for row, value in zip(self._inputs, inputs, strict=True):
            row[:, :count] = value.T
            # The remaining columns repeat a posture, so that they raise no error.
            row[:, count:] = value[:1].T
        with np.errstate(all="ignore"):
            for operation, arguments in operations:
                operation(*arguments)
        return [
            row[:, :count].T.reshape(count, shape[1], shape[0]).transpose(0, 2, 1).copy()
            for row, shape in zip(self._outputs, self._shapes, strict=True)
        ]

    @cached_property
    def _inputs(self) -> list[Array]:
        return [np.zeros((self._function.nnz_in(k), _WIDTH)) for k in range(self._function.n_in())]

    @cached_property
    def _outputs(self) -> list[Array]:
        return [np.zeros((self._function.nnz_out(k), _WIDTH)) for k in range(self._function.n_out())]

    @cached_property
    def _operations(self) -> list[tuple[Callable[..., Any], tuple[Array, ...]]] | None:
        """The operations with their arguments, the result last; ``None`` if NumPy lacks an operation."""
        function, operations = self._function, list[tuple[Callable[..., Any], tuple[Array, ...]]]()
        own = list(np.zeros((function.sz_w(), _WIDTH)))
        # The array that each register of the function currently stands for.
        at, constants = [*own], dict[float, Array]()
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            if code == ca.OP_CONST:
                value = function.instruction_constant(k)
                if value not in constants:
                    constants[value] = np.full(_WIDTH, value)
                at[function.instruction_output(k)[0]] = constants[value]
            elif code == ca.OP_INPUT:
                argument, entry = function.instruction_input(k)
                at[function.instruction_output(k)[0]] = self._inputs[argument][entry]
            elif code == ca.OP_OUTPUT:
                result, entry = function.instruction_output(k)
                operations.append((np.copyto, (self._outputs[result][entry], at[function.instruction_input(k)[0]])))
            elif code in _OPERATIONS:
                arguments = [at[register] for register in function.instruction_input(k)]
                register = function.instruction_output(k)[0]
                at[register] = own[register]
                operations.append((_OPERATIONS[code], (*arguments, own[register])))
            else:
                return None
        return operations
