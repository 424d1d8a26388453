"""This project's own C export, as a user compiles it."""

from __future__ import annotations

from impact_posture.benchmark.case import Case
from impact_posture.benchmark.count import reachable_kb
from impact_posture.benchmark.peer import Peer
from impact_posture.benchmark.work import eval_operations
from impact_posture.benchmark.workbench import CONTRACT, Absent, Workbench, c_compiler, processor
from impact_posture.codegen.export import export
from impact_posture.output_folder import scratch_folder

PREFIX = "kernel"
# What gcc and clang mean by x86-64-v3, as the kernel calls it.
_V3 = frozenset({"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"})


def flag_sets() -> dict[str, list[str]]:
    """Rows and their flags; the one for AVX2 where the processor has it."""
    found = {"ours -O2": ["-O2"]}
    if set(processor()["flags"].split()) >= _V3:
        found["ours -O3 AVX2"] = ["-O3", "-march=x86-64-v3"]
    return found | {"ours -O3 native": ["-O3", "-march=native"]}


def peers(case: Case, bench: Workbench) -> list[Peer]:
    """The export under each set of flags.

    Raises:
        CompilerError: No C compiler.
    """
    compiler = c_compiler()
    with scratch_folder() as folder:
        export(case.objective, folder, prefix=PREFIX, check=False)
        sources = {file: (folder / file).read_text() for file in (f"{PREFIX}.c", f"{PREFIX}.h")}
    text = sources[f"{PREFIX}.c"]
    operations = eval_operations(case.objective)
    found = []
    for label, flags in flag_sets().items():
        try:
            built = bench.build(label, sources, compiler, ["-std=c99", *flags, CONTRACT])
        except Absent as absent:
            bench.skip(label, absent)
            continue
        found.append(
            Peer(
                label,
                "ours",
                "this project's C export",
                built.symbol(f"{PREFIX}_eval"),
                built.symbol(f"{PREFIX}_value"),
                built.flags,
                built.compile_s,
                built.library,
                built.symbol(f"{PREFIX}_eval_batch"),
                operations,
                len(text.encode()) / 1e3,
                reachable_kb(text, f"{PREFIX}_eval"),
            )
        )
    return found


def differences(ours: list[Peer]) -> list[Peer]:
    """∇H by central differences of our own ``H``, of each build."""
    return [
        Peer(
            "differences",
            "differences",
            f"H of '{own.name}' at q and, for each direction, on both sides of it",
            None,
            own.value,
            own.flags,
            own.compile_s,
            own.library,
            by_differences=True,
            tolerance=1e-5,
        )
        for own in ours
    ]
