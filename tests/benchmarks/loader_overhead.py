"""What a call of the exported code costs from Python above the C itself.

Run: python -m tests.benchmarks.loader_overhead
"""

from __future__ import annotations

import ctypes
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from impact_posture.benchmark.timing import Loops, one_core
from impact_posture.benchmark.workbench import Workbench
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.libraries import library_path
from tests.benchmarks.common import default_problem, machine

CASES = [("tilthex_arm", "ee"), ("solo8", "base_link"), ("panda", "panda_hand_tcp")]
CALLS = 200
PASSES = 100


def main() -> None:
    """Print one row a robot: a call through the loader, the same function called from C, and the difference."""
    print(machine())
    print("robot         call us   C us  above us")
    loops = Loops(Workbench())
    n = np.array([0.0, 0.0, 1.0])
    for name, frame in CASES:
        problem = default_problem(name, frame, (0.0, 0.0, 1.0))
        with tempfile.TemporaryDirectory() as folder:
            export(problem.objective, Path(folder), check=False)
            gradient = ImpactGradient.load(Path(folder))
            prefix = str(gradient.manifest["prefix"])
            # The very library that the loader calls.
            library = ctypes.CDLL(str(library_path(Path(folder), prefix)))
            address = ctypes.cast(getattr(library, f"{prefix}_eval"), ctypes.c_void_p)
            q = problem.given
            many = np.tile(q, (CALLS, 1)), np.tile(n, (CALLS, 1)), np.empty(CALLS), np.empty((CALLS, gradient.nv))

            def single(gradient: ImpactGradient = gradient, q: np.ndarray = q) -> None:
                for _ in range(CALLS):
                    gradient.value_and_gradient(q, n)

            with one_core():
                call = statistics.median(thread_time(single) for _ in range(PASSES)) / CALLS
                alone = statistics.median(loops.eval(address, *many) for _ in range(PASSES))
        print(f"{name:12s} {call * 1e6:8.2f} {alone * 1e6:6.2f} {(call - alone) * 1e6:9.2f}")
    if loops.failed:
        raise SystemExit(f"{loops.failed} calls returned an error code")


def thread_time(call: Callable[[], object]) -> float:
    """Processor seconds of a call, by the clock that the loops in C have."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


if __name__ == "__main__":
    main()
