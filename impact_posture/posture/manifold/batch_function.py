"""Evaluate a CasADi function at many postures at once.

CasADi evaluates one posture after another.  For a batch, NumPy runs each operation of the function on all postures
together.  For 512 postures, this takes about a sixth of the time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from impact_posture.system.arrays import Array

# Number of postures that are evaluated together.  With fewer postures, the calls of NumPy take most of the time.
_WIDTH = 512
# Below this number of postures, CasADi is faster.
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


class _Program(NamedTuple):
    """The operations of a function as calls of NumPy, and the arrays of its inputs and outputs, one row each."""

    inputs: list[Array]
    outputs: list[Array]
    calls: list[tuple[Callable[..., Any], tuple[Array, ...]]]


class BatchFunction:
    """A function of a posture, given by expressions, that is called on the rows of arrays."""

    def __init__(self, inputs: list[ca.SX], outputs: list[ca.SX]) -> None:
        self._expressions = inputs, [ca.densify(output) for output in outputs]

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
        count, program = len(inputs[0]), self._program
        for row, value in zip(program.inputs, inputs, strict=True):
            row[:, :count] = value.T
            # The remaining columns repeat a posture, so that they raise no error.
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
    def _program(self) -> _Program:
        """The operations with arrays for ``_WIDTH`` postures."""
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
                calls.append((_OPERATIONS[code], (*arguments, own[register])))
        return _Program(inputs, outputs, calls)
