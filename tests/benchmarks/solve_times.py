"""How long does one solve take, how many certify, and do 16 starts find what 500 find?

Run: python -m tests.benchmarks.solve_times [--many 500]
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

from impact_posture.posture.nlp import PostureNLP, build_nlp
from impact_posture.posture.problem import PostureProblem
from impact_posture.posture.solve import run_start, solve
from impact_posture.posture.starts import feasible_start
from impact_posture.toolchain import find_compiler
from tests.benchmarks.common import crba_time, default_problem, machine

CASES = [
    ("tilthex_arm", "ee", (0.0, 0.0, 1.0), 0.0, 5.0),
    ("tilthex_arm", "ee", (1.0, 0.0, 0.0), 0.0, 5.0),
    ("panda", "panda_hand_tcp", (0.0, 0.0, 1.0), 0.0, 5.0),
    ("talos", "gripper_right_base_link", (1.0, 0.0, 0.0), 0.0, 50.0),
    # A cone of normals, degrees.
    ("tilthex_arm", "ee", (0.0, 0.0, 1.0), 5.0, 10.0),
    ("tilthex_arm", "ee", (0.0, 0.0, 1.0), 20.0, 10.0),
    ("talos", "gripper_right_base_link", (1.0, 0.0, 0.0), 20.0, 150.0),
]
STARTS = 50


def main() -> None:
    """Print one row a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--many", type=int, default=0, help="also compare the best of 16 starts with the best of MANY"
    )
    args = parser.parse_args()
    print(machine())
    print(f"single start, median of {STARTS} random feasible starts; target from the project's goals")
    print("robot         normal   cone  build s  code         solve ms  target  x crba  iterations  certified")
    for name, frame, normal, cone, target in CASES:
        problem = default_problem(name, frame, normal, normal_cone=cone)
        starts = _starts(problem)
        for mode in ("never", "always") if find_compiler() else ("never",):
            _row(name, normal, cone, target, build_nlp(problem, compile=mode), starts)
    if args.many:
        print(f"best of 16 starts against the best of {args.many}")
        for name, frame, normal, cone, _ in CASES:
            problem = default_problem(name, frame, normal, normal_cone=cone)
            began = time.perf_counter()
            few = min(o.objective for o in solve(problem, starts=16).optima)
            many = min(o.objective for o in solve(problem, starts=args.many, seed=7, compile="never").optima)
            print(
                f"{name:13s} {_text(normal):8s} {few / many - 1:+.2%} of the best of {args.many} "
                f"({time.perf_counter() - began:.0f} s)"
            )


def _text(normal: tuple[float, ...]) -> str:
    return " ".join(f"{v:g}" for v in normal)


def _starts(problem: PostureProblem) -> list[np.ndarray]:
    starts: list[np.ndarray] = []
    index = 1
    while len(starts) < STARTS:
        start = feasible_start(problem, index, seed=1)
        index += 1
        if start is not None:
            starts.append(start)
    return starts


def _row(
    name: str, normal: tuple[float, ...], cone: float, target: float, nlp: PostureNLP, starts: list[np.ndarray]
) -> None:
    scale = nlp.problem.objective.value(nlp.problem.given)
    runs = [run_start(nlp, start, scale) for start in starts]
    took = statistics.median(record.time_s for record, _ in runs)
    certified = sum(certificate.holds() for _, certificate in runs) / len(runs)
    print(
        f"{name:13s} {_text(normal):8s} {cone:4g} {nlp.build_time_s:8.2f}  "
        f"{'compiled' if nlp.compiled else 'interpreted':11s} {took * 1e3:9.1f} {target:7.0f} "
        f"{took / crba_time(nlp.problem.robot.model):7.0f} {statistics.median(r.iterations for r, _ in runs):11.0f} "
        f"{certified:10.0%}",
        flush=True,
    )


if __name__ == "__main__":
    main()
