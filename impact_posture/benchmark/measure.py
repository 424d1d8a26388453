"""Time H and ∇H of one robot by this project's C and by its peers, in one run."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Literal

import casadi as ca

from impact_posture.benchmark import adam, dense, ours, pinocchio
from impact_posture.benchmark.case import Case
from impact_posture.benchmark.floor import floor
from impact_posture.benchmark.peer import Peer
from impact_posture.benchmark.report import BenchReport, BenchRow
from impact_posture.benchmark.timing import Disagreement, Harness, one_core
from impact_posture.benchmark.workbench import Absent, Workbench, c_compiler, compiler_version, processor
from impact_posture.errors import CompilerError, InputError
from impact_posture.robot.robot import Robot

PeerName = Literal["pinocchio", "adam", "casadi", "differences"]

PEERS: tuple[PeerName, ...] = ("differences", "pinocchio", "adam", "casadi")
DEFAULT_ROBOTS = ("solo8", "tilthex_arm", "panda", "talos")
_MODULES = {"pinocchio": pinocchio.peers, "adam": adam.peers, "casadi": dense.peers}


def measure(
    robot: Robot,
    frame: str,
    peers: Sequence[PeerName] = PEERS,
    rounds: int = 101,
    patience_s: float = 240.0,
    say: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Medians of H with ∇H, H alone and a batch, ``W = I``, the robot free of supports.

    All ways get the same random configurations and normals, are checked against Pinocchio's dense linear algebra
    before, and are called from C, on one core, in turns.  A peer that cannot run is named in ``skipped``.

    Args:
        robot: The robot.
        frame: Contact frame.
        peers: What to compare with.
        rounds: Passes over all configurations.
        patience_s: Processor seconds that a compiler may take for one build.
        say: Called with what is being done.

    Raises:
        InputError: No round, no patience, or an unknown peer.
        FrameNotFound, ContactError: Nothing that moves is called that.
        CompilerError: No C compiler, or none of our builds worked.
    """
    _check(peers, rounds, patience_s)
    case = Case.of(robot, frame)
    bench = Workbench(patience_s, say)
    say("generating the C export")
    made = ours.peers(case, bench)
    if "differences" in peers:
        made += ours.differences(made)
    for name in (p for p in _MODULES if p in peers):
        try:
            made += _MODULES[name](case, bench)
        except Absent as absent:
            bench.skip(name, absent)
    try:
        harness = Harness(case, bench)
    except Absent as absent:
        raise CompilerError(str(absent), where="bench", hint="check the compiler or set CC to another") from None
    kept, differences = _agreeing(made, harness, bench)
    say(f"timing, {rounds} rounds")
    with one_core() as core:
        times = harness.times(kept, rounds)
    best = min(t.eval for t, p in zip(times, kept, strict=True) if t.eval is not None and p.group == "ours")
    rows = _fastest([BenchRow.of(p, t, best, d) for p, t, d in zip(kept, times, differences, strict=True)])
    least = floor(robot, case.point[0]) if case.plain else None
    return BenchReport(
        robot.name, frame, robot.nq, robot.nv, len(case.q), rounds, core, tuple(rows), tuple(bench.skipped),
        tuple(bench.notes), least,
    )  # fmt: skip


def _check(peers: Sequence[str], rounds: int, patience_s: float) -> None:
    if rounds < 1:
        raise InputError(f"asked for {rounds}", where="--rounds", hint="give one or more")
    if not patience_s >= 1:
        raise InputError(f"is {patience_s:g} s", where="--patience", hint="give a second or more")
    for name in peers:
        if name not in PEERS:
            raise InputError(f"no peer '{name}'", where="--peers", hint=f"one of: {', '.join(PEERS)}")


def _fastest(rows: list[BenchRow]) -> list[BenchRow]:
    """Of the differences of each of our builds the fastest alone."""
    found = [row for row in rows if row.group == "differences"]
    slower = sorted(found, key=lambda row: row.eval_us)[1:]
    return [row for row in rows if row not in slower]


def _agreeing(made: Sequence[Peer], harness: Harness, bench: Workbench) -> tuple[list[Peer], list[float]]:
    """Those that compute the right numbers, and by how much they differ.

    Raises:
        CompilerError: None of ours is among them.
    """
    kept, differences = [], []
    for peer in made:
        try:
            differences.append(harness.check(peer))
        except Disagreement as wrong:
            bench.skip(peer.name, wrong)
        else:
            kept.append(peer)
    if not any(peer.group == "ours" for peer in kept):
        reasons = "; ".join(f"{s.name}: {s.reason}" for s in bench.skipped if s.name.startswith("ours"))
        raise CompilerError(
            f"no build of the export is right ({reasons})",
            where="bench",
            hint="run impact-posture verify on this robot and frame",
        )
    return kept, differences


def machine() -> dict[str, str | int | float | None]:
    """What this runs on and with."""
    return {
        "processor": processor()["name"] or "unknown processor",
        "architecture": platform.machine(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
        "compiler": compiler_version(c_compiler()),
        "python": platform.python_version(),
        "casadi": str(ca.CasadiMeta.version()),
        "pinocchio": version("pin"),
    }
