"""H and ∇H side by side: this project's C against Pinocchio C++, ADAM's C and dense formulations, in one run.

Same robot, same 256 random configurations and normals, numbers compared to 1e-6 first; loops in C, one core, peers in
turns, medians of the thread's processor time.  A peer that is not installed is named and left out.

Columns: H with ∇H, its ratio to the faster of ours, H alone, how many times that H with ∇H is, ours over a batch per
configuration; arithmetic as written in the source of H with ∇H; the source file and what H with ∇H takes of it;
processor seconds of the compiler for the whole file.

Run: python -m tests.benchmarks.kernel_times [--robot NAME] [--peers pinocchio,adam,casadi] [--rounds N]
"""

from __future__ import annotations

import argparse
import importlib
import os
from pathlib import Path

import numpy as np

from impact_posture.impact.contact import Contact
from impact_posture.impact.metric import Metric
from impact_posture.impact.oracle import ImpactOracle
from tests.benchmarks.common import machine
from tests.benchmarks.kernel import ours
from tests.benchmarks.kernel.build import Absent, cache_folder
from tests.benchmarks.kernel.case import COUNT, FRAMES, Case
from tests.benchmarks.kernel.floor import floor
from tests.benchmarks.kernel.peer import Peer
from tests.benchmarks.kernel.timing import Disagreement, Harness, Times, one_core

MODULES = {"pinocchio": "pinocchio", "adam": "adam", "casadi": "dense"}


def main() -> None:
    """Print one table a robot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--robot", choices=[*FRAMES], action="append", help="repeatable; all of them by default")
    parser.add_argument("--peers", default=",".join(MODULES), help="comma-separated; empty for ours alone")
    parser.add_argument("--rounds", type=int, default=101)
    asked = parser.parse_args()
    wanted = [p for p in asked.peers.split(",") if p]
    for name in wanted:
        if name not in MODULES:
            parser.error(f"no peer {name}: {', '.join(MODULES)}")
    print(f"{machine()}, {_processor()}, load {os.getloadavg()[0]:.1f}; cache {cache_folder()}")
    for robot in asked.robot or FRAMES:
        run(robot, wanted, asked.rounds)


def run(name: str, wanted: list[str], rounds: int) -> None:
    """One robot's table."""
    case = Case.of(name)
    notes: list[str] = []
    try:
        peers = ours.peers(case)
    except Absent as absent:
        print(f"{name} skipped: {absent}")
        return
    for peer in wanted:
        try:
            peers += importlib.import_module(f"tests.benchmarks.kernel.{MODULES[peer]}").peers(case, notes)
        except Absent as absent:
            notes.append(f"{peer} skipped: {absent}")
    harness = Harness(case)
    reference = _reference(case)
    kept = []
    for peer in peers:
        try:
            notes.append(f"{peer.name}: differs from the oracle by {harness.check(peer, reference):.0e}")
            kept.append(peer)
        except Disagreement as wrong:
            notes.append(f"LEFT OUT, {wrong}")
    with one_core() as core:
        times = harness.times(kept, rounds)
    print(f"\n{name} at {case.frame}: nq {case.robot.nq}, nv {case.robot.nv}, {COUNT} configurations, core {core}")
    _table(case, kept, times)
    commands = dict.fromkeys(peer.flags for peer in kept)
    for line in [*notes, *[f"$ {command}" for command in commands]]:
        print(f"  {line}")


def _reference(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """H and ∇H by the oracle's dense linear algebra, which shares no code with any of the peers."""
    H, gradients = [], []
    for q, n in zip(case.q, case.n, strict=True):
        x, y, z = (float(v) for v in n)
        oracle = ImpactOracle(case.robot, Contact.create(case.frame, (x, y, z)), Metric())
        H.append(oracle.quantities(q).H)
        gradients.append(oracle.gradient_H(q))
    return np.array(H), np.array(gradients)


_HEADS = " H, ∇H µs  ratio    H µs   ∇/H  batch    ops    mul    add  div trig    kB of it compile s"


def _table(case: Case, peers: list[Peer], times: list[Times]) -> None:
    best = min(t.eval for t, p in zip(times, peers, strict=True) if t.eval is not None and p.name.startswith("ours"))
    width = max(len(p.name) for p in peers)
    print(f"  {'':{width}} {_HEADS}")
    for peer, took in zip(peers, times, strict=True):
        cells = [
            _cell(took.eval, 9, 1e6, 3),
            _cell(took.eval, 6, 1 / best, 2),
            _cell(took.value, 7, 1e6, 3),
            _cell(took.eval / took.value if took.eval and took.value else None, 5, 1.0, 2),
            _cell(took.batch, 6, 1e6, 3),
        ]
        done = peer.operations
        counts = (done.total, done.mul, done.add, done.div, done.trig) if done else (None,) * 5
        cells += [_cell(c, w, 1.0, 0) for c, w in zip(counts, (6, 6, 6, 4, 4), strict=True)]
        cells += [_cell(kb, 5, 1.0, 0) for kb in peer.source_kb or (None, None)]
        print(f"  {peer.name:{width}} {' '.join(cells)} {peer.compile_s:9.1f}")
    least = floor(case.robot, case.point[0])
    print(f"  {'floor (articulated bodies + adjoint, by count)':{width + 36}}"
          f" {least.total:6} {least.mul:6} {least.add:6} {least.div:4} {least.trig:4}")  # fmt: skip
    for peer, took in zip(peers, times, strict=True):
        if took.value is not None and peer.name.startswith(("ours -O3 native", "Pinocchio hand")):
            differences = 2 * case.robot.nv * took.value
            print(f"  central differences of {peer.name}'s H, {2 * case.robot.nv} calls: {differences * 1e6:.1f} µs,"
                  f" {differences / best:.0f} ×")  # fmt: skip


def _cell(value: float | None, width: int, scale: float, digits: int) -> str:
    return f"{value * scale:{width}.{digits}f}" if value is not None else f"{'-':>{width}}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return "unknown processor"
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "unknown processor")


if __name__ == "__main__":
    main()
