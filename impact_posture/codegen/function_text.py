"""Template variables of one exported function, for C and for CUDA."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from impact_posture.codegen.block_layout import Layout
from impact_posture.codegen.c_emitter import Emitter
from impact_posture.codegen.export_functions import SIGNATURES, lengths
from impact_posture.codegen.export_library import Exported


def function_variables(
    function: Exported, emitter: Emitter, calls: Sequence[str], normals: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    """Return the variables in :attr:`~impact_posture.codegen.c_source.CSource.functions`."""
    inputs, results = SIGNATURES[function.name]
    sizes = [len(emitter.layout.graph.outputs[output]) for output in function.outputs]
    return {
        "stem": function.stem,
        "name": function.name,
        "normal": None if "n" in inputs else normals[function.stem],
        "calls": calls,
        "outputs": [*assignments(function, emitter, "m.")],
        "finite": [*zip(results, sizes, strict=True)],
    }


def angles_of(layout: Layout) -> tuple[int, ...]:
    """Return the index in ``q`` of each angle whose sine and cosine are computed."""
    return tuple(layout.graph.nodes[k].args[1] for k in layout.angles)


def assignments(function: Exported, emitter: Emitter, work: str) -> Iterator[dict[str, Any]]:
    """Yield the assignments of the results of a function; names of work arrays begin with ``work``."""
    graph, arrays = emitter.layout.graph, lengths(0, 0)
    for name, output in zip(SIGNATURES[function.name][1], function.outputs, strict=True):
        for k, node in enumerate(graph.outputs[output]):
            target, value = f"{name}[{k}]" if name in arrays else f"*{name}", emitter.output(node, work)
            yield {"target": target, "value": value, "constant": graph.nodes[node].op == "const"}
