"""The exported controller against the one in Python: equal commands, and what a tick takes of one core.

``python -m tests.benchmarks.controller FOLDER [TICKS]`` writes ``FOLDER/controller.md``.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.robot.robot import Robot
from impact_posture.toolchain import find_compiler
from impact_posture.tsid.controller import Command, Controller, Status
from tests.benchmarks.core import Vector, machine, one_core, table
from tests.exported_controller import KINDS, compiled, exported, formulation_of, random_state

HARNESS = Path(__file__).with_name("controller_times.c")
# Push (acceleration of each joint, relative), or size of a random state.
STATES = {"quiet": 0.0, "pushed": 3.0, "saturated": 30.0, "random": 0.05, "far": 0.3}
# A repetition is interrupted by other programs; the least of some is the tick's own.
REPETITIONS = 7
BUILDS = {"-O2": ["-O2"], "native": ["-O3", "-march=native"]}


@dataclass
class Agreement:
    """Ticks of one kind of state.

    Attributes:
        solved: Ticks that both solved.
        worst: Largest relative difference of their controls.
        differ: Solved ticks whose controls differ by more than 1e-9.
        better: Those of them in which C answers as well as Python, or better (:func:`no_worse`).
        relaxed: Ticks that both relaxed.
        other: Ticks with different statuses, as ``Python/C``.
        states: The states, row by row.
        python: Time of each tick in Python, µs.
    """

    solved: int = 0
    worst: float = 0.0
    differ: int = 0
    better: int = 0
    relaxed: int = 0
    other: dict[str, int] = field(default_factory=dict)
    states: list[Vector] = field(default_factory=list)
    python: list[float] = field(default_factory=list)


def states(robot: Robot, kind: str, controller: Controller, ticks: int) -> Iterator[tuple[Vector, Vector, Command]]:
    """Yield states and the commands of Python: random ones, or those of a robot that is pushed now and then."""
    rng, size = np.random.default_rng(7), STATES[kind]
    q, v = robot.posture(), np.zeros(robot.nv)
    push = np.zeros(robot.nv)
    for k in range(ticks):
        if kind in ("random", "far"):
            q, v = random_state(robot, rng, size)
        elif k % 1000 == 0:
            # A robot that fell is set up again.
            q, v = robot.posture(), np.zeros(robot.nv)
        command = controller.tick(1e-3 * k, q, v)
        yield q, v, command
        if k % 50 == 0:
            push = size * rng.normal(size=robot.nv) * (k % 100 == 0)
        v = v + 1e-3 * (command.acceleration + push)
        q = np.asarray(pin.integrate(robot.model, q, 1e-3 * v))


def agreement(name: str, kind: str, ticks: int) -> Agreement:
    """Run both controllers over the same states."""
    robot, formulation = formulation_of(name)
    ours, theirs, found = Controller(robot, formulation), compiled(name), Agreement()
    for controller in (ours, theirs):
        controller.reset(robot.posture(), np.zeros(robot.nv))
    before = time.process_time_ns()
    for k, (q, v, a) in enumerate(states(robot, kind, ours, ticks)):
        found.python.append((time.process_time_ns() - before) / 1e3)
        b = theirs.tick(1e-3 * k, q, v)
        found.states.append(np.concatenate([q, v]))
        if a.status is b.status is Status.SOLVED:
            found.solved += 1
            difference = float(np.max(np.abs(a.u - b.u)) / max(1.0, float(np.max(np.abs(a.u)))))
            found.worst = max(found.worst, difference)
            if difference > 1e-9:
                found.differ += 1
                found.better += no_worse(ours, a, b)
        elif a.status is b.status is Status.RELAXED:
            found.relaxed += 1
        else:
            pair = f"{a.status.value}/{b.status.value}"
            found.other[pair] = found.other.get(pair, 0) + 1
        before = time.process_time_ns()
    return found


def no_worse(controller: Controller, a: Command, b: Command) -> bool:
    """Return whether ``b`` answers the last program as well as ``a``: it violates less, or it costs no more.

    Python opens bounds a little where its solver fails at the program as it stands, and then it costs less.
    """
    qp = controller.assembly.rank.qp
    z, other = (np.concatenate([c.acceleration, c.forces]) for c in (a, b))
    size = 1.0 + float(np.max(np.abs(qp.A) @ np.abs(z)))
    cost, its = (float(0.5 * x @ qp.H @ x + qp.g @ x) for x in (z, other))
    exact, ours, theirs = 1e-10 * size, qp.violation(z), qp.violation(other)
    return theirs <= max(ours, exact) and (ours > exact or its <= cost + 1e-10 * (1.0 + abs(cost)))


def times(name: str, recorded: list[Vector], flags: list[str], cold: bool) -> tuple[float, float]:
    """Return median and 99th percentile of the ticks, each the least of its repetitions, µs."""
    folder = exported(name)
    with tempfile.TemporaryDirectory() as scratch:
        program, data = Path(scratch) / "times", Path(scratch) / "ticks.bin"
        np.array([recorded[0], *recorded]).tofile(data)
        sources = ["ctl.c", "ctl_relaxation.c", "ctl_daqp.c", str(HARNESS)]
        command = [*(find_compiler() or ["cc"]), "-std=c99", "-ffp-contract=fast", "-isystem", "daqp", "-I.", *flags]
        subprocess.run([*command, *sources, "-o", str(program), "-lm"], cwd=folder, check=True)
        runs = []
        for _ in range(REPETITIONS):
            ran = subprocess.run([program, data, *(["cold"] if cold else [])], capture_output=True, check=True)
            runs.append([int(line.split()[0]) for line in ran.stdout.splitlines()])
    least = np.min(np.array(runs), axis=0) / 1e3
    return float(np.median(least)), float(np.percentile(least, 99))


def main(out: Path, ticks: int) -> None:
    """Write the tables."""
    rows, speeds = list[list[str]](), list[list[str]]()
    for name in KINDS:
        quiet = []
        for kind in STATES:
            found = agreement(name, kind, ticks)
            others = ", ".join(f"{count} {pair}" for pair, count in found.other.items()) or "none"
            rows.append(
                [
                    name,
                    kind,
                    str(found.solved),
                    f"{found.worst:.0e}",
                    f"{found.better} of {found.differ}",
                    str(found.relaxed),
                    others,
                ]
            )
            quiet = quiet or [found]
            print(*rows[-1], flush=True)
        recorded, python = quiet[0].states, np.array(quiet[0].python)
        speeds.append([name, f"{np.median(python):.0f} / {np.percentile(python, 99):.0f}"])
        for flags, cold in ((BUILDS["-O2"], False), (BUILDS["native"], False), (BUILDS["-O2"], True)):
            speeds[-1].append("{:.1f} / {:.1f}".format(*times(name, recorded, flags, cold)))
        print(*speeds[-1], flush=True)
    agree = [
        "robot",
        "states",
        "solved",
        "largest difference of u",
        "over 1e-9: C as good or better",
        "relaxed",
        "other (Python/C)",
    ]
    speed = ["robot", "Python, µs", "C -O2", "C native", "C -O2, caches flushed"]
    lines = [
        machine("daqp"),
        "",
        *table(agree, rows),
        "",
        "Median / p99 over quiet states.",
        "",
        *table(speed, speeds),
    ]
    out.mkdir(parents=True, exist_ok=True)
    (out / "controller.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    with one_core():
        main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 2000)
