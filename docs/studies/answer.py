"""Time that ``optimize`` needs to print its answer, and to write figures and C code."""

from __future__ import annotations

import os
import pty
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from docs.studies.core import Request, machine, table

# Name of a case → options of ``optimize``, and goals for the time until the printed answer and until the end, s (two
# idle cores, warm caches).
CASES = {
    "tilthex_arm": ("tilthex_arm --normal 0 0 1", 1.2, 2.5),
    "talos, hand": ("talos --frame gripper_right_base_link --normal -1 0 0", 2.5, 5.0),
}
# Text in the last line of the printed answer.
_ANSWER = b"solves by IPOPT certified in"


class Run(NamedTuple):
    """Times of a run, s: wall time until the answer, wall time until the end, processor time until the end."""

    answer: float
    end: float
    busy: float


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each case and program.

    Runs of the programs alternate, so that other work on the machine affects all programs equally.
    """
    this = str(Path(sys.executable).with_name("impact-posture"))
    programs = {"this": this} | ({"other": request.against} if request.against else {})
    yield f"{machine()}; medians of {request.count} runs in a terminal, after a run that warms the caches."
    yield ""
    head = ("case", "program", "answer s", "target", "end s", "target", "processor s")
    yield from table(head, _rows(request, programs))


def _rows(request: Request, programs: dict[str, str]) -> Iterator[list[str]]:
    for case, (options, answer, end) in CASES.items():
        if request.only not in case:
            continue
        runs_of: dict[str, list[Run]] = {name: [] for name in programs}
        for _ in range(1 + request.count):
            for name, program in programs.items():
                runs_of[name].append(timed([program, "optimize", *options.split()]))
        for name, runs in runs_of.items():
            middle = Run(*(statistics.median(times) for times in zip(*runs[1:], strict=True)))
            yield [case, name, *f"{middle.answer:.2f}|{answer}|{middle.end:.2f}|{end}|{middle.busy:.2f}".split("|")]
            if name == "this" and (middle.answer > answer or middle.end > end):
                request.missed.append(f"{case}: {middle.answer:.2f} s and {middle.end:.2f} s")


def timed(command: list[str]) -> Run:
    """Run a command in a new terminal.  The output folder of the command is temporary.

    The command may write Python bytecode, as it would for a user.
    """
    ours, theirs = pty.openpty()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryDirectory() as folder:
        before, began = os.times(), time.perf_counter()
        process = subprocess.Popen(
            [*command, "--out", f"{folder}/result"],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            close_fds=True,
            env=environment,
        )
        os.close(theirs)
        text, answer = b"", 0.0
        while chunk := _read(ours):
            text += chunk
            if not answer and _ANSWER in text:
                answer = time.perf_counter() - began
        code, end, after = process.wait(), time.perf_counter() - began, os.times()
        os.close(ours)
    if code or not answer:
        raise RuntimeError(f"{' '.join(command)} ended with {code}:\n{text.decode(errors='replace')}")
    busy = after.children_user + after.children_system - before.children_user - before.children_system
    return Run(answer, end, busy)


def _read(terminal: int) -> bytes:
    """Read the output of a terminal.  Return no bytes at the end of the output, which Linux reports as an error."""
    try:
        return os.read(terminal, 1 << 16)
    except OSError:
        return b""
