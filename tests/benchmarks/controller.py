"""The exported controller against the one in Python: equal commands, and what a tick takes of one core.

``python -m tests.benchmarks.controller FOLDER [TICKS]`` writes ``FOLDER/controller.md``.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin

from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.manifest import read_controller
from impact_posture.robot.robot import Robot
from impact_posture.toolchain import find_compiler
from impact_posture.tsid.controller import Command, Controller, Status
from tests.benchmarks import controller_peer
from tests.benchmarks.core import Vector, machine, one_core, table
from tests.benchmarks.flow import CASES
from tests.exported_controller import (
    KINDS,
    abuse_program,
    compiled,
    exported,
    formulation_of,
    impact_of,
    random_state,
)

HARNESS = Path(__file__).with_name("controller_times.c")
# Push (acceleration of each joint, relative), or size of a random state.
STATES = {"quiet": 0.0, "pushed": 3.0, "saturated": 30.0, "random": 0.05, "far": 0.3}
# A repetition is interrupted by other programs; the least of some is the tick's own.
REPETITIONS = 7
# Frames of the impacts with which the impact-robust term is timed; robots that tick a million times.
IMPACTS = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "solo8": "base_link", "talos": "torso_2_link"}
GROWTH = ("tilthex_arm", "panda", "solo8")
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


def flowing(name: str, ticks: int) -> tuple[Path, list[Vector]]:
    """Return the folder of a controller with a reference flow, and the states of a robot that follows the flow."""
    objective = next(case for case in CASES if case.robot == name).problem().objective
    folder, robot = exported(name, objective, path=()), objective.robot
    controller, recorded = CompiledController.load(folder), list[Vector]()
    q, v = robot.posture(), np.zeros(robot.nv)
    controller.reset(q, v)
    controller.brace()
    for k in range(ticks):
        recorded.append(np.concatenate([q, v]))
        v = v + 1e-3 * controller.tick(1e-3 * k, q, v).acceleration
        q = np.asarray(pin.integrate(robot.model, q, 1e-3 * v))
    return folder, recorded


def times(folder: Path, recorded: list[Vector], flags: list[str], cold: bool) -> tuple[float, float]:
    """Return median and 99th percentile of the ticks, each the least of its repetitions, µs."""
    least = _least(folder, recorded, flags, [["cold"] if cold else []])[0][:, 0]
    return float(np.median(least)), float(np.percentile(least, 99))


def robust_over_nominal(name: str, frame: str, recorded: list[Vector]) -> list[str]:
    """Return a row: how much longer ticks are with the impact-robust term, every fifth tick and every tick."""
    robot = formulation_of(name)[0]
    folder = exported(name, impact_of(robot, frame, (0.0, 0.0, 1.0)))
    nominal, fifth, every = _least(folder, recorded, ["-O2"], [[], ["5"], ["1"]])
    alone = float(np.mean(every[:, 1]))
    more = float(np.mean(every[:, 0] - nominal[:, 0]))
    share = float(np.mean(fifth[:, 0]) / np.mean(nominal[:, 0]))
    return [name, f"{np.mean(nominal[:, 0]):.2f}", f"{alone:.2f}", f"{share:.3f}", f"{more / alone:.2f}"]


def _least(folder: Path, recorded: list[Vector], flags: list[str], variants: list[list[str]]) -> list[Vector]:
    """Return, for each list of arguments, the least time of each tick and of its gradient, µs, shape (ticks, 2)."""
    with tempfile.TemporaryDirectory() as scratch:
        program, data = Path(scratch) / "times", Path(scratch) / "ticks.bin"
        np.array([recorded[0], *recorded]).tofile(data)
        sources = ["ctl.c", *read_controller(folder)[1].sources, str(HARNESS)]
        command = [*(find_compiler() or ["cc"]), "-std=c99", "-ffp-contract=fast", "-isystem", "daqp", "-I.", *flags]
        subprocess.run([*command, *sources, "-o", str(program), "-lm"], cwd=folder, check=True)
        least = [np.full((len(recorded), 2), np.inf) for _ in variants]
        for found, words in REPETITIONS * list(zip(least, variants, strict=True)):
            ran = subprocess.run([program, data, *words], capture_output=True, check=True)
            numbers = [[int(line.split()[k]) for k in (0, 3)] for line in ran.stdout.splitlines()]
            np.minimum(found, np.array(numbers) / 1e3, out=found)
    return least


def growth(name: str, ticks: int) -> str:
    """Return what random ticks, half of them with limits that permit nearly nothing, take of memory."""
    with tempfile.TemporaryDirectory() as scratch:
        ran = subprocess.run(
            [abuse_program(exported(name), Path(scratch)), str(ticks)], capture_output=True, text=True, check=True
        )
    return ran.stdout.partition(";")[0]


def main(out: Path, ticks: int) -> None:
    """Write the tables."""
    rows, speeds, ratios = list[list[str]](), list[list[str]](), list[list[str]]()
    with ExitStack() as stack:
        try:
            peer, why = stack.enter_context(controller_peer.peer()), ""
        except controller_peer.Missing as missing:
            peer, why = None, str(missing)
        _measure(rows, speeds, ratios, ticks, peer)
    agree = [
        "robot",
        "states",
        "solved",
        "largest difference of u",
        "over 1e-9: C as good or better",
        "relaxed",
        "other (Python/C)",
    ]
    theirs = f"Pinocchio and DAQP, C++ {why}".strip()
    flow = "on the way of a flow, C -O2"
    speed = ["robot", "Python, µs", "C -O2", "C native", "C -O2, caches flushed", flow, theirs]
    ratio = ["robot", "nominal, µs", "gradient", "every fifth tick, over nominal", "every tick: more, over gradient"]
    lines = [
        machine("daqp"),
        "",
        *table(agree, rows),
        "",
        "Median / p99 over quiet states, and while the posture flows.",
        "",
        *table(speed, speeds),
        "",
        "With the impact-robust term, means over quiet states.",
        "",
        *table(ratio, ratios),
        "",
        *(f"{name}: {growth(name, 1_000_000)} in a million random ticks" for name in GROWTH),
    ]
    out.mkdir(parents=True, exist_ok=True)
    (out / "controller.md").write_text("\n".join([*lines, ""]), encoding="utf-8")
    print(*lines, sep="\n")


def _measure(
    rows: list[list[str]], speeds: list[list[str]], ratios: list[list[str]], ticks: int, peer: Path | None
) -> None:
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
            speeds[-1].append("{:.1f} / {:.1f}".format(*times(exported(name), recorded, flags, cold)))
        speeds[-1].append("{:.1f} / {:.1f}".format(*times(*flowing(name, 4 * ticks), BUILDS["-O2"], False)))
        found = None if peer is None else controller_peer.times(peer, name, recorded)
        speeds[-1].append("–" if found is None else "{:.1f} / {:.1f}".format(*found))
        print(*speeds[-1], flush=True)
        if name in IMPACTS:
            ratios.append(robust_over_nominal(name, IMPACTS[name], recorded))


if __name__ == "__main__":
    with one_core():
        main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 2000)
