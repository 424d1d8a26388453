"""H and ∇H of a robot that stands beside the same robot free, both as exported C."""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path

import numpy as np

from impact_posture.benchmark.case import Case
from impact_posture.benchmark.ours import flag_sets
from impact_posture.benchmark.timing import Loops, one_core
from impact_posture.benchmark.workbench import CONTRACT, Workbench, c_compiler
from impact_posture.codegen.export import export
from tests.benchmarks.common import default_problem

ROBOTS = {"solo8": "base_link", "solo12": "base_link", "g1": "right_rubber_hand", "talos": "gripper_right_base_link"}
PREFIX, ROUNDS = "feet", 61


def feet_table() -> list[str]:
    """A row a robot and set of flags; printed as they come."""
    lines = [
        "",
        "| exported H and ∇H | made by | standing µs | free µs | ratio | target |",
        "|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    loops = Loops(bench := Workbench())
    for name, frame in ROBOTS.items():
        problem = default_problem(name, frame, (1.0, 0.0, 0.0))
        case = Case.of(problem.robot, frame)
        q, n = np.ascontiguousarray(case.q), np.ascontiguousarray(case.n)
        H, gradient = np.zeros(len(q)), np.zeros((len(q), problem.robot.nv))
        with tempfile.TemporaryDirectory() as folder:
            export(problem.objective, Path(folder), prefix=PREFIX, check=False)
            sources = {file: (Path(folder) / file).read_text() for file in (f"{PREFIX}.c", f"{PREFIX}.h")}
        for label, flags in flag_sets().items():
            built = bench.build(label, sources, c_compiler(), ["-std=c99", *flags, CONTRACT])
            both = [built.symbol(f"{PREFIX}_eval"), built.symbol(f"{PREFIX}_free_eval")]
            times: list[list[float]] = [[], []]
            with one_core():
                for _ in range(ROUNDS):
                    for function, own in zip(both, times, strict=True):
                        loops.eval(function, q, n, H, gradient)
                        own.append(loops.eval(function, q, n, H, gradient))
            standing, free = (statistics.median(own) * 1e6 for own in times)
            target = "2.5" if name == "talos" else "–"
            cells = [
                name,
                label.removeprefix("ours "),
                f"{standing:.3f}",
                f"{free:.3f}",
                f"{standing / free:.2f}",
                target,
            ]
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    if loops.failed:
        raise SystemExit(f"{loops.failed} calls returned an error code")
    return lines
