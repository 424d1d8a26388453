"""A CasADi function as CasADi's own C, behind the harness's signature."""

from __future__ import annotations

import tempfile
from pathlib import Path

import casadi as ca

from tests.benchmarks.kernel.build import Absent, build, c_compiler, symbol
from tests.benchmarks.kernel.count import count_operations, reachable_kb
from tests.benchmarks.kernel.peer import Peer

_WRAPPER = """
int kernel_eval(const double *q, const double *n, double *H, double *grad)
{{
  const double *arg[{arg}];
  double *res[{res}];
  casadi_int iw[{iw}];
  double w[{w}];
  arg[0] = q;
  arg[1] = n;
  res[0] = H;
  res[1] = grad;
  return eval(arg, res, iw, w, 0);
}}
"""
# Where -O2 took longer than this, -O3 is not tried.
_PATIENCE_S = 120.0


def base_rotation(q: ca.SX) -> ca.SX:
    """Rotation of the quaternion ``q[3:7]``, x y z w, of unit norm."""
    x, y, z, w = (q[k] for k in range(3, 7))
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def function_of(q: ca.SX, n: ca.SX, step: ca.SX, H: ca.SX) -> ca.Function:
    """``(q, n) → H, ∇H`` by reverse mode with respect to ``step``, at zero step; common subexpressions found."""
    general = ca.Function("general", [q, n, step], [H, ca.densify(ca.gradient(H, step))])
    values = general.call([q, n, ca.DM.zeros(step.shape)])
    return ca.Function("eval", [q, n], values, ["q", "n"], ["H", "grad"], {"cse": True})


def c_source(function: ca.Function) -> str:
    """CasADi's C of the function with the wrapper."""
    with tempfile.TemporaryDirectory() as name:
        generator = ca.CodeGenerator("peer.c", {"with_header": False})
        generator.add(function)
        generator.generate(f"{name}/")
        text = (Path(name) / "peer.c").read_text()
    sizes = {"arg": function.sz_arg(), "res": function.sz_res(), "iw": function.sz_iw(), "w": function.sz_w()}
    return text + _WRAPPER.format(**{key: max(1, size) for key, size in sizes.items()})


def compiled(label: str, source: str, notes: list[str]) -> list[Peer]:
    """The source at -O2, at -O1 where that is too slow, and at -O3 -march=native where that is not.

    Raises:
        Absent: No compiler, or none of them ended in time.
    """
    found: list[Peer] = []
    operations = count_operations(source, "kernel_eval")
    for flags in (["-O2"], ["-O1"], ["-O3", "-march=native"]):
        if flags == ["-O1"] and found:
            continue
        if "-O3" in flags and (not found or found[0].compile_s > _PATIENCE_S or "-O1" in found[0].flags):
            notes.append(f"{label}: -O3 -march=native not tried, the compiler is too slow on it")
            continue
        try:
            built = build({"peer.c": source}, c_compiler(), flags, ["-lm"])
        except Absent as absent:
            notes.append(f"{label} {' '.join(flags)}: {absent}")
            continue
        name = f"{label} {' '.join(flags).replace('-march=', '')}"
        kb = (len(source.encode()) / 1e3, reachable_kb(source, "kernel_eval"))
        address = symbol(built.library, "kernel_eval")
        found.append(Peer(name, address, None, built.command, built.compile_s, built.library, None, operations, kb))
    if not found:
        raise Absent("no compilation ended")
    return found
