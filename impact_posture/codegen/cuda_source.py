"""Generate the CUDA code that templates insert."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pinocchio as pin

from impact_posture.codegen.block_layout import lay_out
from impact_posture.codegen.c_emitter import Constants, Emitter
from impact_posture.codegen.c_literals import Real
from impact_posture.codegen.export_functions import BLOCK_THREADS, SIGNATURES
from impact_posture.codegen.export_library import Exported, ExportLibrary
from impact_posture.codegen.expression_graph import Graph
from impact_posture.codegen.function_text import angles_of, function_variables
from impact_posture.codegen.limb_order import limb_of_coordinates, limb_of_joints, limbs_of_nodes, order_by_limb
from impact_posture.codegen.limb_warps import LANES, WARPS, WarpSchedule, lay_out_warps, schedule

# Up to this number of operations, the blocks of a CUDA function are inlined, so that values can stay in registers.
# In longer functions, separate blocks make the compiler store fewer values in memory, and kernels use several warps.
_INLINED = 6000
# Largest number of statements in a CUDA block that is not inlined.  On an H100, talos in double precision reaches
# 105 million evaluations/s with 600 statements, 95 million with 300, and 91 million with 200 or 1,000.
_CUDA_BLOCK = 600
# Several warps compute a configuration if this divides the number of operations in a row at least by 2.
_FASTER = 2
# Static shared memory of a block in CUDA, bytes.
_SHARED = 48 * 1024


@dataclass(frozen=True)
class CudaSource:
    """CUDA code of all functions of an export.  Each function has its own blocks.

    Attributes:
        inlined: Whether the blocks are inlined.
        constants: Definitions of the tables of constants.
        functions: Template variables of each function: the variables in
            :attr:`~impact_posture.codegen.c_source.CSource.functions`, ``blocks``, ``angles`` and ``work`` (length
            of the work array).
        kernels: Template variables of each function whose kernels compute a configuration by several warps: the
            variables in ``functions``, ``warps`` (angles, calls in each stage, and outputs of each warp), ``shared``
            (number of shared values of a configuration), and ``names`` (name of each kernel, C literal of the factor
            of its results, and name of its first result).
    """

    inlined: bool
    constants: str
    functions: tuple[dict[str, Any], ...]
    kernels: tuple[dict[str, Any], ...]

    @property
    def by_warps(self) -> set[tuple[str, str]]:
        """Stem and name of the functions whose kernels compute a configuration by several warps."""
        return {(f["stem"], name["name"]) for f in self.kernels for name in f["names"]}

    @property
    def rows(self) -> int:
        """Number of configurations that a block computes at once, in the kernels with gradients."""
        return BLOCK_THREADS // (WARPS if self.kernels else 1)


def build_cuda_source(
    library: ExportLibrary,
    model: pin.Model,
    normals: Mapping[str, Sequence[float]],
    scales: Mapping[str, str],
    prefix: str,
    real: Real,
) -> CudaSource:
    """Generate the CUDA code of the functions of a ``lean`` library.

    ``normals`` and ``scales`` map a stem to the normal of its contact, and to the C literal of the ratio of the
    objective to ``H`` (empty if the ratio is not constant).
    """
    graph, limb_of, limb_of_joint = library.graph(), limb_of_coordinates(model), limb_of_joints(model)
    visits = [(k, limb_of_joint[j]) for k, j in zip(graph.outputs["visits"], library.joints, strict=True)]
    limbs = [limbs_of_nodes(graph, function.outputs, visits, limb_of) for function in library.functions]
    orders = [order_by_limb(graph, each) for each in limbs]
    longest = max(map(len, orders))
    block = longest if (inlined := longest <= _INLINED) else _CUDA_BLOCK
    constants = Constants(prefix, real, "static __constant__ const")
    functions, kernels = [], []
    for function, each, order in zip(library.functions, limbs, orders, strict=True):
        layout = lay_out(graph, [function.outputs], block, order)
        emitter = Emitter(layout, f"{function.stem}_{function.name}", real, {1: real.name}, constants)
        variables = function_variables(function, emitter, [b.call for b in emitter.blocks], normals)
        work = layout.sizes.get(1, 0)
        functions.append(variables | {"blocks": emitter.blocks, "angles": angles_of(layout), "work": work})
        if function.name in ("eval", "objective") and not inlined:
            plan = schedule(graph, each)
            if _FASTER * plan.cost <= len(order):
                kernels.append(_by_warps(function, graph, plan, real, constants, normals, scales))
    fitting = [k for k in kernels if k["shared"] * LANES * real.size + 4 * BLOCK_THREADS <= _SHARED]
    return CudaSource(inlined, constants.text({1: real.name}), tuple(functions), tuple(fitting))


def _by_warps(
    function: Exported,
    graph: Graph,
    plan: WarpSchedule,
    real: Real,
    constants: Constants,
    normals: Mapping[str, Sequence[float]],
    scales: Mapping[str, str],
) -> dict[str, Any]:
    """Return the template variables of a function whose kernels compute a configuration by several warps."""
    layout = lay_out_warps(graph, function.outputs, plan)
    emitter = Emitter(layout, f"{function.stem}_{function.name}_warps", real, {1: real.name}, constants)
    variables = function_variables(function, emitter, [], normals)
    results = [k for name in function.outputs for k in graph.outputs[name]]
    warps = []
    for warp in range(WARPS):
        calls: list[list[str]] = [[] for _ in range(plan.count)]
        for block, text in zip(layout.blocks, emitter.blocks, strict=True):
            if plan.warps[block.nodes[0]] == warp:
                calls[plan.stages[block.nodes[0]]].append(text.call)
        used = {a for k, w in plan.warps.items() if w == warp for a in graph.nodes[k].operands}
        places = {layout.trig[a] for a in used if a in layout.trig}
        own = [plan.warps.get(k, 0) == warp for k in results]
        warps.append({
            "stages": calls,
            "angles": [(place, angle) for place, angle in enumerate(angles_of(layout)) if place in places],
            "outputs": [output for output, mine in zip(variables["outputs"], own, strict=True) if mine],
        })  # fmt: skip
    names = [{"name": function.name, "scale": "", "result": SIGNATURES[function.name][1][0]}]
    if function.name == "eval" and scales[function.stem]:
        names.append({"name": "objective", "scale": scales[function.stem], "result": "value"})
    return variables | {
        "normal": normals[function.stem], "blocks": emitter.blocks, "warps": warps, "names": names,
        "shared": layout.shared_size, "room": max(1, len(layout.angles)), "work": max(1, layout.sizes.get(1, 0)),
    }  # fmt: skip
