"""Run sweeps whose executors are disturbed, and check that another run continues them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from impact_posture.sweep.sweep_file import read_sweep
from impact_posture.sweep.sweep_run import run_sweep
from tests.hostile.arena import Outcome

COMMAND = [sys.executable, str(Path(sys.executable).with_name("impact-posture"))]
# A sweep of ten shards.
GRID = """shard = 3
[problem]
robot = "tilthex_arm"
normal = [0, 0, 1]
[grid]
x = { from = -0.1, to = 0.1, count = 5 }
z = { from = -0.1, to = 0.1, count = 6 }
"""


@contextlib.contextmanager
def running(*words: object, **more: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program during the block."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", **more}
    process = subprocess.Popen(
        list(map(str, words)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment,
        start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def shards(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.glob("data/*/*.parquet"))}


def interrupted(words: list[str], out: Path, harm: Callable[[int], None], **more: str) -> Outcome:
    """Run a sweep, and call ``harm(pid)`` after its first shard."""
    process = subprocess.Popen(
        [*words, "--out", str(out), "--quiet"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, env=os.environ | {"OMP_NUM_THREADS": "1", **more},
    )  # fmt: skip
    end = time.monotonic() + 120
    while not list(out.rglob("*.parquet")) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    try:
        harm(process.pid)
        texts = process.communicate(timeout=240)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    return Outcome(tuple(words), process.returncode, *texts, ())


def check(outcome: Outcome, sweep: Path, out: Path) -> None:
    """Check the outcome, and that another run on this machine continues with the same bytes."""
    assert not outcome.complaints, (outcome.complaints, outcome.err)
    again = subprocess.run([*COMMAND, "sweep", str(sweep), "--workers", "1", "--quiet", "--out", str(out)])
    assert again.returncode == 0
    run_sweep(read_sweep(sweep), sweep.with_name("whole"))
    assert shards(out) == shards(sweep.with_name("whole"))
