"""What a call of the exported code costs from Python above the C itself.

Run: python -m tests.benchmarks.loader_overhead
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from impact_posture.codegen.export import export
from impact_posture.codegen.loader import ImpactGradient
from tests.benchmarks.common import default_problem, machine, median_time

CASES = [("tilthex_arm", "ee"), ("solo8", "base_link"), ("panda", "panda_hand_tcp")]
CALLS = 200


def main() -> None:
    """Print one row a robot: a call through the loader, the same in a batch (the C alone), and the difference."""
    print(machine())
    print("robot         call us   C us  above us")
    n = np.array([0.0, 0.0, 1.0])
    for name, frame in CASES:
        problem = default_problem(name, frame, (0.0, 0.0, 1.0))
        with tempfile.TemporaryDirectory() as folder:
            export(problem.objective, Path(folder), check=False)
            gradient = ImpactGradient.load(Path(folder))
            q = problem.given
            many = np.tile(q, (CALLS, 1)), np.tile(n, (CALLS, 1))
            out = np.empty(CALLS, gradient.dtype), np.empty((CALLS, gradient.nv), gradient.dtype)

            def single(gradient: ImpactGradient = gradient, q: np.ndarray = q) -> None:
                for _ in range(CALLS):
                    gradient.value_and_gradient(q, n)

            call = median_time(single, 100) / CALLS
            alone = median_time(lambda g=gradient, m=many, o=out: g.value_and_gradient_batch(*m, o), 100) / CALLS
        print(f"{name:12s} {call * 1e6:8.2f} {alone * 1e6:6.2f} {(call - alone) * 1e6:9.2f}")


if __name__ == "__main__":
    main()
