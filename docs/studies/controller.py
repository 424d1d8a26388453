"""Compare the exported controller with the Python controller: equal commands, growth of memory, time of a tick.

``python -m docs.studies.controller [TICKS] [equality|growth|times]`` runs one part or all parts, and writes a page of
the documentation for each part.  Only the part ``times`` needs an idle machine.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pinocchio as pin

from docs.studies import controller_equality, controller_peer
from docs.studies.controller_equality import objective_of
from docs.studies.core import Vector, machine, one_core, page_of, table
from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.controller_manifest import read_controller
from impact_posture.system.toolchain import find_compiler
from impact_posture.tsid.controller import Controller
from tests.support.exported_controller import KINDS, exported, formulation_of, impact_of

HARNESS = Path(__file__).with_name("controller_times.c")
# Number of repetitions of a tick.  Other programs interrupt some repetitions, so the shortest time is used.
REPETITIONS = 7
# Number of timed ticks.
TIMED = 1000
# Number of random ticks during which the memory must not grow.
RANDOM = 1_000_000
# Contact frames of the impacts for which the impact-robust term is timed.
IMPACTS = {"tilthex_arm": "ee", "panda": "panda_hand_tcp", "solo8": "base_link", "talos": "torso_2_link"}
BUILDS = {"-O2": ["-O2"], "native": ["-O3", "-march=native"]}
_HEAD = "<!-- Written by `make study-controller`; do not edit. -->"


def quiet(name: str, ticks: int) -> tuple[list[Vector], list[float]]:
    """Return the states of a robot that the Python controller keeps at rest, and the time of each tick, µs."""
    robot, formulation = formulation_of(name)
    controller, recorded, taken = Controller(robot, formulation), list[Vector](), list[float]()
    q, v = robot.posture(), np.zeros(robot.nv)
    controller.reset(q, v)
    for k in range(ticks):
        before = time.process_time_ns()
        command = controller.tick(1e-3 * k, q, v)
        taken.append((time.process_time_ns() - before) / 1e3)
        recorded.append(np.concatenate([q, v]))
        v = v + 1e-3 * command.acceleration
        q = np.asarray(pin.integrate(robot.model, q, 1e-3 * v))
    return recorded, taken


def flowing(name: str, ticks: int) -> tuple[Path, list[Vector]]:
    """Return the folder of an exported controller with a reference flow, and the states of a robot that it moves."""
    objective = objective_of(name)
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
    """Return the median and the 99th percentile of the tick times, µs, from the shortest time of each tick."""
    least = _least(folder, recorded, flags, [["cold"] if cold else []])[0][:, 0]
    return float(np.median(least)), float(np.percentile(least, 99))


def robust_over_nominal(name: str, frame: str, recorded: list[Vector]) -> list[str]:
    """Return a table row with times of nominal ticks, and of ticks that update the impact-robust term.

    The term is updated at every tick or at every fifth tick.
    """
    robot = formulation_of(name)[0]
    folder = exported(name, impact_of(robot, frame, (0.0, 0.0, 1.0)))
    nominal, fifth, every = _least(folder, recorded, ["-O2"], [[], ["5"], ["1"]])
    alone = float(np.mean(every[:, 1]))
    more = float(np.mean(every[:, 0] - nominal[:, 0]))
    share = float(np.mean(fifth[:, 0]) / np.mean(nominal[:, 0]))
    return [name, f"{np.mean(nominal[:, 0]):.2f}", f"{alone:.2f}", f"{share:.3f}", f"{more / alone:.2f}"]


def _least(folder: Path, recorded: list[Vector], flags: list[str], variants: list[list[str]]) -> list[Vector]:
    """Return the shortest time of each tick and of its gradient, µs, shape (ticks, 2).

    ``variants`` are lists of arguments for ``controller_times.c``.  Each list gets a separate array of times.
    """
    with tempfile.TemporaryDirectory() as scratch:
        program, data = Path(scratch) / "times", Path(scratch) / "ticks.bin"
        np.array([recorded[0], *recorded]).tofile(data)
        sources = ["ctl.c", *read_controller(folder)[1].sources, str(HARNESS)]
        command = [*(find_compiler() or ["cc"]), "-std=c99", "-ffp-contract=fast", "-isystem", "daqp", "-I.", *flags]
        subprocess.run([*command, *sources, "-o", str(program), "-lm"], cwd=folder, check=True)
        least = [np.full((len(recorded), 2), np.inf) for _ in variants]
        for shortest, words in REPETITIONS * list(zip(least, variants, strict=True)):
            ran = subprocess.run([program, data, *words], capture_output=True, check=True)
            numbers = [[int(line.split()[k]) for k in (0, 3)] for line in ran.stdout.splitlines()]
            np.minimum(shortest, np.array(numbers) / 1e3, out=shortest)
    return least


def equality(ticks: int) -> Iterator[str]:
    """Yield a table of the differences between both controllers in the same states."""
    some, most = controller_equality.SOME, controller_equality.MOST
    yield (
        f"{ticks} ticks for each kind of states. Errors of controls are relative to the largest control. *Its own*: "
        "largest change of Python's controls, in ticks over 1e-9, if the last digit of each number in the program "
        f"changes. In ticks with different answers (the first {most}), and in every {some}th relaxed tick: largest "
        "violation of hard constraints, and largest residual of optimality, by an independent certificate."
    )
    yield ""
    yield from table(controller_equality.HEAD, controller_equality.equality(ticks))


def growth(_: int) -> Iterator[str]:
    head = ["robot", "random ticks", "growth", "statuses: solved, relaxed, infeasible, unsolved, not finite"]
    yield from table(head, controller_equality.growth(RANDOM))


def times_of_ticks(_: int) -> Iterator[str]:
    """Yield times of a tick in Python, in C, and in handwritten C++. Each row appears as soon as it is measured."""
    ratios = list[list[str]]()
    yield f"Median / p99 of {TIMED} quiet states, µs; a tick in C and C++ is the shortest of {REPETITIONS}."
    yield ""
    with ExitStack() as stack:
        try:
            peer, why = stack.enter_context(controller_peer.peer()), ""
        except controller_peer.Missing as missing:
            peer, why = None, str(missing)
        theirs = f"Pinocchio and DAQP, C++ {why}".strip()
        head = ["robot", "Python", "C -O2", "C native", "C -O2, caches flushed", "with a moving flow, C -O2", theirs]
        yield from table(head, _speeds(peer, ratios))
    yield from ("", "With the impact-robust term, means over quiet states.", "")
    ratio = ["robot", "nominal, µs", "gradient", "every fifth tick, over nominal", "every tick: more, over gradient"]
    yield from table(ratio, ratios)


def _speeds(peer: Path | None, ratios: list[list[str]]) -> Iterator[list[str]]:
    for name in KINDS:
        recorded, python = quiet(name, TIMED)
        row = [name, f"{np.median(python):.0f} / {np.percentile(python, 99):.0f}"]
        for flags, cold in ((BUILDS["-O2"], False), (BUILDS["native"], False), (BUILDS["-O2"], True)):
            row.append("{:.1f} / {:.1f}".format(*times(exported(name), recorded, flags, cold)))
        row.append("{:.1f} / {:.1f}".format(*times(*flowing(name, 3 * TIMED), BUILDS["-O2"], False)))
        peer_times = None if peer is None else controller_peer.times(peer, name, recorded)
        row.append("–" if peer_times is None else "{:.1f} / {:.1f}".format(*peer_times))
        if name in IMPACTS:
            ratios.append(robust_over_nominal(name, IMPACTS[name], recorded))
        yield row


PARTS = {"equality": equality, "growth": growth, "times": times_of_ticks}


def main(ticks: int, parts: list[str]) -> None:
    """Write the results of each part into the page of this part."""
    for part in parts:
        lines = [_HEAD, "", machine("daqp"), ""]
        for line in PARTS[part](ticks):
            print(line, flush=True)
            lines.append(line)
        page_of(f"controller-{part}").write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    words = sys.argv[1:]
    fits = all(word.isdecimal() for word in words[:1]) and words[1:] in ([], *([part] for part in PARTS))
    if not fits:
        sys.exit(f"usage: python -m docs.studies.controller [TICKS] [{'|'.join(PARTS)}]")
    with one_core():
        main(int(words[0]) if words else 10_000, words[1:] or list(PARTS))
