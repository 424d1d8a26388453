"""Run a command line in a fork of this process, which has imported all modules, and assess and count the results."""

from __future__ import annotations

import gc
import io
import os
import resource
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from impact_posture_cli.argv import put_right
from impact_posture_cli.error_boundary import run
from tests.experiment.conftest import shortened
from tests.support.command import PARSER

CODES = {0, 1, 2, 3, 4, 130, 143}
# Lines of a usage error begin with these words.
USAGE = ("Usage: ", "Try ", "Error: ")
# Texts that only libraries and interpreters print, never the program itself.
NOISE = ("Traceback", "internal error", "Warning:", "Exception ignored", "terminate called", "Segmentation", "DEBUG")
# Permitted processor time of an attack, s.
BUSY = 60
# Time after which an attack is treated as hanging, s.
PATIENCE = 120

SMALL = """<robot name="small">
  <link name="world_link"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="1.5"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.01 0 0.15"/><mass value="0.8"/>
    <inertia ixx="0.01" iyy="0.012" izz="0.003" ixy="0" ixz="0.001" iyz="0"/></inertial></link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="world_link"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="20" velocity="3"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="10" velocity="4"/></joint>
  <joint name="wrist" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0 0 0.3"/></joint>
</robot>
"""
PUSH = ("small.urdf", "--frame", "tip", "--normal", "1", "0", "0")
# A sweep of two points.
SWEEP = """
[problem]
robot = "small.urdf"
frame = "tip"
normal = [1, 0, 0]
contact_pose = "free"
starts = 1
[grid]
speed = [1, 2]
"""


def write_short_scenario(folder: Path) -> None:
    """Write ``short.toml``, a scenario with one early contact."""
    short = {"count": 1, "gap": 0.1, "settle": 0.1, "dwell": 0.2, "pause": 0.05}
    text = shortened("aerial-vertical", **short, timestep=0.0005, period=0.002)
    (folder / "short.toml").write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Outcome:
    """Outcome of a command line: exit code (negative for a signal), output and changed files."""

    argv: tuple[str, ...]
    code: int
    out: str
    err: str
    changed: tuple[str, ...]

    @property
    def complaints(self) -> list[str]:
        """Return a list of faults in the outcome of the command line."""
        lines = [line for line in self.err.splitlines() if line.strip() and not line.startswith("warning: ")]
        errors = [line for line in lines if line.startswith(("error: ", "Error: "))]
        complaints = [f"says {word!r}" for word in NOISE if word in self.err or word in self.out]
        if self.code not in CODES:
            complaints.append(f"exit code {self.code}")
        elif self.code == 0 and lines:
            complaints.append("writes to standard error after success")
        elif self.code and len(errors) != 1:
            complaints.append(f"{len(errors)} error lines")
        elif any(line not in errors and not (self.code == 2 and line.startswith(USAGE)) for line in lines):
            complaints.append("more than one line")
        if self.code and self.changed:
            complaints.append(f"fails and leaves {', '.join(self.changed)}")
        return complaints


@dataclass
class Tally:
    """Number of inputs that the running test has tried, and number of inputs with a complaint."""

    tried: int = 0
    mishandled: int = 0


TALLY = Tally()


@contextmanager
def judging() -> Iterator[Callable[..., None]]:
    """Yield a function that counts inputs with their list of complaints; fail at the end with all complaints."""
    failures, before = [], TALLY.tried

    def judge(case: str, complaints: Sequence[str], count: int = 1) -> None:
        TALLY.tried += count
        if complaints:
            TALLY.mishandled += 1
            failures.append(f"{case}\n    {'; '.join(complaints)}")

    yield judge
    assert not failures, f"{len(failures)} of {TALLY.tried - before}:\n" + "\n".join(failures)


def strike(folder: Path, *argv: str, before: Callable[[], None] | None = None) -> Outcome:
    """Run and count a command line in a folder, and return the outcome.  The process first calls ``before``."""
    TALLY.tried += 1
    return _strike(folder, argv, before)


def _strike(folder: Path, argv: tuple[str, ...], prepare: Callable[[], None] | None = None) -> Outcome:
    before = _content(folder)
    streams = [os.memfd_create(name) for name in ("out", "err")]
    child = os.fork()
    if child == 0:
        _become(folder, argv, streams, prepare)
    status = _wait(child)
    texts = []
    for stream in streams:
        os.lseek(stream, 0, os.SEEK_SET)
        with os.fdopen(stream, "rb") as file:
            texts.append(file.read().decode(errors="replace"))
    after = _content(folder)
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    return Outcome(argv, os.waitstatus_to_exitcode(status), texts[0], texts[1], tuple(changed))


def attack(
    cases: Iterable[tuple[str, ...]], folder: Path, arrange: Callable[[int], object] = lambda k: None
) -> list[Outcome]:
    """Run all command lines, each after ``arrange(k)``; fail with a list of all complaints."""
    outcomes = []
    with judging() as judge:
        for k, argv in enumerate(cases):
            arrange(k)
            outcome = _strike(folder, argv)
            outcomes.append(outcome)
            words = outcome.err.strip()[-300:]
            judge(f"case {k}: {shlex.join(argv)[:300]!a}, {words!a}", outcome.complaints)
    return outcomes


def _become(folder: Path, argv: tuple[str, ...], streams: list[int], prepare: Callable[[], None] | None) -> None:
    code = 70
    try:
        gc.freeze()
        signal.alarm(PATIENCE)
        resource.setrlimit(resource.RLIMIT_CPU, (BUSY, BUSY))
        os.chdir(folder)
        for number, stream in zip((1, 2), streams, strict=True):
            os.dup2(stream, number)
        sys.stdout, sys.stderr = (io.TextIOWrapper(os.fdopen(n, "wb", closefd=False)) for n in (1, 2))
        sys.argv = ["impact-posture", *argv]
        if prepare is not None:
            prepare()
        code = run(PARSER, put_right(argv))
        for file in (sys.stdout, sys.stderr):
            file.flush()
    finally:
        os._exit(code)


def _wait(child: int) -> int:
    end = time.monotonic() + 2 * PATIENCE
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status
        time.sleep(0.002)
    with suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def _content(folder: Path) -> dict[str, bytes]:
    paths = folder.rglob("*")
    return {p.relative_to(folder).as_posix(): p.read_bytes() if p.is_file() else b"" for p in paths}
