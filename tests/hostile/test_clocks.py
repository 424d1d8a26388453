"""Commands work with clocks that are wrong or run backwards, and with files from the past and the future.

Wrong clocks need ``--hostile-full`` and libfaketime.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.hostile.arena import SWEEP, Outcome, judging, strike, write_short_scenario

COMMAND = str(Path(sys.executable).parent / "impact-posture")
FAKETIME = next((str(path) for path in Path("/usr/lib").glob("*/faketime/libfaketime.so.1")), "")
PUSH = ("small.urdf", "--frame", "tip", "--normal", "1", "0", "0.3")
COMMANDS = (
    ("optimize", *PUSH, "--contact-pose", "free", "--starts", "1", "--no-codegen", "--format", "pdf", "--out", "out"),
    ("codegen", "out", "--out", "c", "--compile"),
    ("codegen", "out", "--out", "c", "--compile", "--force"),
    ("report", "out"),
    ("verify", "out", "--samples", "1"),
    ("compare", "short.toml", "--controllers", "nominal", "--seeds", "1", "--out", "cmp"),
    # libfaketime damages the memory of forked processes.
    ("sweep", "sweep.toml", "--workers", "1", "--out", "s"),
    ("sweep", "show", "s"),
)
# Seconds of a year, and modification times of files, s.
YEAR = 365 * 86_400
FILES = (0, -YEAR, 2**31 + 1, 2**33, 140 * YEAR)
# Clocks.  The first clock runs backwards, by one second per second.
CLOCKS = (
    "@2030-01-01 00:00:00 x-1",
    "@1970-01-02 00:00:00",
    "@1901-12-14 00:00:00",
    "@2038-01-19 03:14:06",
    "@2108-01-01 00:00:00",
)


def prepare(folder: Path) -> None:
    write_short_scenario(folder)
    (folder / "sweep.toml").write_text(SWEEP)


@pytest.mark.skipif(not FAKETIME, reason="libfaketime is not installed")
@pytest.mark.parametrize("clock", CLOCKS)
def test_wrong_clocks(clock: str, arena: Path, hostile_full: bool) -> None:
    if not hostile_full:
        pytest.skip("wrong clocks: give --hostile-full")
    prepare(arena)
    environment = os.environ | {"LD_PRELOAD": FAKETIME, "FAKETIME": clock, "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    with judging() as judge:
        # With a clock that runs backwards, the simplex method of HiGHS 1.13 in the wheels of CasADi writes outside
        # its memory, so no sweep runs.  The interior-point method is correct, but takes 1.5 times as long.
        for argv in COMMANDS[:-2] if clock == CLOCKS[0] else COMMANDS:
            done = subprocess.run(
                [COMMAND, *argv, "--quiet"], cwd=arena, capture_output=True, text=True, env=environment, timeout=300
            )
            outcome = Outcome(argv, done.returncode, done.stdout, done.stderr, ())
            complaints = outcome.complaints + ([f"exit code {outcome.code}"] if outcome.code else [])
            judge(f"{argv[:2]}: {outcome.err[-300:]!a}", complaints)


@pytest.mark.long(but=("-31536000", "8589934592"))
@pytest.mark.parametrize("seconds", FILES)
def test_files_from_the_past_and_the_future(seconds: int, result: Path, arena: Path) -> None:
    shutil.copytree(result, arena / "out")
    for path in (*arena.rglob("*"), arena):
        os.utime(path, (seconds, seconds))
    for argv in (
        ("evaluate", *PUSH),
        ("codegen", "out", "--out", "c"),
        ("report", "out"),
        ("verify", "out", "--samples", "1"),
    ):
        outcome = strike(arena, *argv)
        assert (outcome.code, outcome.complaints) == (0, []), outcome.err
