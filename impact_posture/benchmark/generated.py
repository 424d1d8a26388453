"""A CasADi function as CasADi's own C, behind the harness's signature."""

from __future__ import annotations

import casadi as ca

from impact_posture.benchmark.count import count_operations, reachable_kb
from impact_posture.benchmark.peer import Group, Peer
from impact_posture.benchmark.workbench import CONTRACT, Absent, Workbench, c_compiler
from impact_posture.output_folder import scratch_folder

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
# -O3 takes up to this many times what -O2 takes.
_LONGER = 2.0


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
    with scratch_folder() as folder:
        generator = ca.CodeGenerator("peer.c", {"with_header": False})
        generator.add(function)
        generator.generate(f"{folder}/")
        text = (folder / "peer.c").read_text()
    sizes = {"arg": function.sz_arg(), "res": function.sz_res(), "iw": function.sz_iw(), "w": function.sz_w()}
    return text + _WRAPPER.format(**{key: max(1, size) for key, size in sizes.items()})


def compiled(label: str, group: Group, what: str, source: str, bench: Workbench) -> list[Peer]:
    """The source at -O2, at -O1 where that is too slow, and at -O3 -march=native where that is not.

    Raises:
        Absent: No compiler, or none of them ended in time.
    """
    found: list[Peer] = []
    compiler = c_compiler()
    operations = count_operations(source, "kernel_eval")
    for flags in (["-O2"], ["-O1"], ["-O3", "-march=native"]):
        name = f"{label} {' '.join(flags).replace('-march=', '')}"
        if flags == ["-O1"] and found:
            continue
        if "-O3" in flags and not (found and found[0].compile_s * _LONGER < bench.patience_s):
            bench.skip(name, "not tried, as the compiler took too long at less" + _longer(found))
            continue
        try:
            # GNU C: what CasADi writes is compiled as people compile it.
            built = bench.build(f"{name}: {what}", {"peer.c": source}, compiler, [*flags, CONTRACT])
        except Absent as absent:
            bench.skip(name, absent)
            continue
        address = built.symbol("kernel_eval")
        sizes = len(source.encode()) / 1e3, reachable_kb(source, "kernel_eval")
        found.append(
            Peer(
                name,
                group,
                what,
                address,
                None,
                built.flags,
                built.compile_s,
                built.library,
                None,
                operations,
                *sizes,
            )
        )
    return found


def _longer(found: list[Peer]) -> str:
    return f" ({found[0].compile_s:.0f} s); see --patience" if found else "; see --patience"
