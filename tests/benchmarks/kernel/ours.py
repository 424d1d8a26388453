"""This project's own C export, as a user compiles it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from impact_posture.codegen.export import export
from tests.benchmarks.kernel.build import build, c_compiler, symbol
from tests.benchmarks.kernel.case import Case
from tests.benchmarks.kernel.count import count_operations, reachable_kb
from tests.benchmarks.kernel.peer import Peer

FLAG_SETS = {"ours -O2": ["-O2"], "ours -O3 native": ["-O3", "-march=native"]}
PREFIX = "kernel"


def peers(case: Case) -> list[Peer]:
    """The export under each set of flags."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export(case.objective, folder, prefix=PREFIX, check=False)
        sources = {file: (folder / file).read_text() for file in (f"{PREFIX}.c", f"{PREFIX}.h")}
    text = sources[f"{PREFIX}.c"]
    operations = count_operations(text, f"{PREFIX}_eval")
    found = []
    for label, flags in FLAG_SETS.items():
        built = build(sources, c_compiler(), ["-std=c99", *flags], ["-lm"])
        found.append(
            Peer(
                label,
                symbol(built.library, f"{PREFIX}_eval"),
                symbol(built.library, f"{PREFIX}_value"),
                built.command,
                built.compile_s,
                built.library,
                symbol(built.library, f"{PREFIX}_eval_batch") if f"{PREFIX}_eval_batch" in text else None,
                operations,
                (len(text.encode()) / 1e3, reachable_kb(text, f"{PREFIX}_eval")),
            )
        )
    return found
