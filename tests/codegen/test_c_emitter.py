"""Every CasADi operation is written as C, and number literals are read back exactly."""

from __future__ import annotations

import ctypes
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from impact_posture.codegen.block_layout import lay_out
from impact_posture.codegen.c_emitter import Constants, Emitter
from impact_posture.codegen.c_literals import DOUBLE, c_double
from impact_posture.codegen.expression_graph import CALLS, graph_of
from impact_posture.errors import CompilerError
from impact_posture.system.toolchain import run_compiler
from tests.support.tools import STRICT, need_compiler

OPTIMIZED = True


def c_function(function: ca.Function) -> str:
    """Return the C code of ``void f(inputs..., outputs...)`` for a CasADi SX function."""
    graph = graph_of(function)
    layout = lay_out(graph, [function.name_out()], block=10)
    constants = Constants("f", DOUBLE)
    emitter = Emitter(layout, "f", DOUBLE, {1: "double"}, constants)
    blocks = "\n".join(block.text for block in emitter.blocks)
    parameters = [f"const double *{v}" for v in graph.inputs] + [f"double *{v}" for v in graph.outputs]
    angles = len(layout.angles)
    lines = [f"struct {{ double s[{angles + 1}], c[{angles + 1}], w[{layout.sizes.get(1, 0) + 1}]; }} m;"]
    for k, node in enumerate(layout.angles):
        lines += [f"m.s[{k}] = sin({emitter.output(node)});", f"m.c[{k}] = cos({emitter.output(node)});"]
    lines += [block.call for block in emitter.blocks]
    for name, nodes in graph.outputs.items():
        lines += [f"{name}[{k}] = {emitter.output(node)};" for k, node in enumerate(nodes)]
    lines += [f"(void){name};" for name in graph.inputs]
    body = "\n  ".join(lines)
    head = f"#include <math.h>\n{constants.text({1: 'double'})}\n{blocks}"
    return f"{head}\nvoid f({', '.join(parameters)});\nvoid f({', '.join(parameters)})\n{{\n  {body}\n}}\n"


def test_every_operation_of_the_emitter(tmp_path: Path) -> None:
    compiler = need_compiler()
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    a, b = x[0], x[1]
    values = [
        a + b, a - b, a * b, a / b, -a, a**2, 2 * a, 1 / b, ca.exp(a), ca.log(b), b**a, b**2.5, ca.sqrt(b),
        ca.sin(a), ca.cos(a), ca.tan(a), ca.asin(x[2]), ca.acos(x[2]), ca.atan(a), ca.atan2(a, b), ca.tanh(a),
        ca.hypot(a, b), ca.fabs(a), ca.fmin(a, b), ca.fmax(a, b), ca.sign(a), a < b, a <= b, ca.eq(a, b),
        ca.ne(a, b), ca.logic_not(a < b), ca.logic_and(a < b, b < 1), ca.logic_or(a > b, b > 1),
        ca.if_else(a > b, a, b), a * -0.1, b + 1e-300, ca.SX(-3.5), ca.SX(0), ca.SX(np.inf),
    ]  # fmt: skip
    outputs = ca.sparsify(ca.vertcat(*values))
    function = ca.Function("f", [x, y], [outputs, ca.sin(a) * b], ["x", "y"], ["out", "extra"])
    used = {function.instruction_id(k) for k in range(function.n_instructions())}
    assert set(CALLS) <= used
    text = c_function(function)
    (tmp_path / "f.c").write_text(f"#define APART static __attribute__((noinline))\n{text}")
    library = tmp_path / "f.so"
    command = [*compiler, "-std=c99", *STRICT, "-O2", "-fPIC", "-shared", "f.c", "-o", str(library), "-lm"]
    run_compiler(command, tmp_path)
    call = ctypes.CDLL(str(library)).f
    for point in ([0.3, 0.7, 0.5], [-0.4, 0.2, -0.9], [2.0, 2.0, 0.0], [1.5, 1.2, 1.0]):
        result, extra = np.full(len(values), np.nan), np.full(1, np.nan)
        arrays = [np.array(point), np.zeros(2), result, extra]
        call(*[v.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for v in arrays])
        expected = [np.array(v.full(), dtype=float).ravel() for v in function(point, [0, 0])]
        np.testing.assert_allclose(result, expected[0], rtol=1e-14)
        np.testing.assert_allclose(extra, expected[1], rtol=1e-14)


def test_an_operation_that_has_no_c() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(CompilerError, match="cannot be written in C"):
        graph_of(ca.Function("f", [x], [ca.erf(x)], ["x"], ["y"]))


@pytest.mark.parametrize("value", [0.1, -0.1, 1e-310, 1e22, -1 / 3, 5e-324, 1.7976931348623157e308, 0.0, -0.0])
def test_literals_read_back_exactly(value: float) -> None:
    text = c_double(value)
    assert float(text.strip("()")) == value
    assert np.signbit(float(text.strip("()"))) == np.signbit(value)
    assert text.startswith("(") == bool(np.signbit(value))
