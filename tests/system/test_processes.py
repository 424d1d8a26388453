"""Work in several processes: all results arrive, errors reach the caller, and all processes end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from impact_posture.errors import ControllerNotFound, ImpactPostureError, InputError, SimulationDiverged, WorkerDied
from impact_posture.system.processes import end_early, fork_call, fork_map, signals_held, undone

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs /proc to look at processes")


def alive(pid: int) -> bool:
    """Whether a process is running and is not a zombie."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return False


def gone(pids: list[int], within: float = 10.0) -> bool:
    end = time.monotonic() + within
    while any(alive(pid) for pid in pids):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_every_index_comes_once_with_its_result(jobs: int) -> None:
    # An open file cannot be sent to another process, but a fork inherits it.
    with open(__file__, encoding="utf-8") as file:

        def work(index: int) -> tuple[int, int]:
            # The first calls are the slowest, so they end last in parallel processes.
            time.sleep(0.02 * (3 - index) if index < 3 else 0)
            return index**2 * (file.name == __file__), os.getpid()

        with fork_map(work, 7, jobs) as results:
            values = dict(results)
    assert {index: square for index, (square, _) in values.items()} == {k: k**2 for k in range(7)}
    pids = {pid for _, pid in values.values()}
    assert (os.getpid() in pids) == (jobs == 1) and len(pids) <= jobs
    assert jobs == 1 or gone(list(pids))
    with fork_map(work, 0, jobs) as results:
        assert list(results) == []


def test_a_killed_worker_is_an_error() -> None:
    def work(index: int) -> int:
        if index == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return index

    with pytest.raises(WorkerDied, match="`jobs` 1"), fork_map(work, 6, 2) as results:
        list(results)
    with fork_map(lambda index: index, 3, 2) as results:
        assert sorted(results) == [(k, k) for k in range(3)]


@pytest.mark.parametrize("jobs", [1, 3])
@pytest.mark.parametrize(
    "error",
    [
        SimulationDiverged(1.25, where="solo8"),
        ControllerNotFound("robsut", ("robust", "nominal"), hint="look"),
        ZeroDivisionError("by zero"),
    ],
    ids=lambda e: type(e).__name__,
)
def test_the_error_of_a_worker_reaches_the_caller(error: Exception, jobs: int) -> None:
    def work(index: int) -> int:
        if index == 2:
            raise error
        return index

    with pytest.raises(type(error)) as caught, fork_map(work, 6, jobs) as results:
        for _ in results:
            pass
    assert str(caught.value) == str(error)
    if isinstance(error, ImpactPostureError):
        assert vars(caught.value) == vars(error)


@pytest.mark.parametrize("fails", [True, False])
def test_leaving_early_leaves_no_process(fails: bool, tmp_path: Path) -> None:
    def work(index: int) -> int:
        (tmp_path / str(os.getpid())).touch()
        if index == 0 and fails:
            raise ValueError("stop")
        time.sleep(0 if index == 0 else 30)
        return index

    begin = time.monotonic()
    expected = pytest.raises(ValueError, match="stop") if fails else contextlib.nullcontext()
    with expected, fork_map(work, 4, 2) as results:
        assert next(results) == (0, 0)
    assert time.monotonic() - begin < 15
    pids = [int(path.name) for path in tmp_path.iterdir()]
    assert pids and gone(pids)
    with fork_map(lambda index: -index, 4, 2) as results:
        assert dict(results) == {k: -k for k in range(4)}


PROGRAM = """
import os, sys, time
from pathlib import Path
from impact_posture.system.processes import fork_map

def work(index):
    Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(60)

try:
    with fork_map(work, 4, 2) as results:
        list(results)
except KeyboardInterrupt:
    print("stopped")
    sys.exit(130)
"""


@pytest.mark.parametrize("send", [os.kill, os.killpg], ids=["to the parent", "to the group, as a terminal does"])
def test_ctrl_c_leaves_no_process_and_no_noise(tmp_path: Path, send: Callable[[int, int], None]) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        end = time.monotonic() + 60
        while len(list(tmp_path.iterdir())) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        workers = [int(path.name) for path in tmp_path.iterdir()]
        assert len(workers) == 2 and all(alive(pid) for pid in workers)
        send(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=30)
        assert (process.returncode, out, err) == (130, "stopped\n", "")
        assert gone(workers)
    finally:
        # Only processes of this test belong to the group.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


KILLED = """
import os, sys, time
from pathlib import Path
from impact_posture.system.processes import fork_call, fork_map
from impact_posture.system.toolchain import run_compilers

folder = Path(sys.argv[2])

def linger(index=0):
    Path(folder, str(os.getpid())).touch()
    time.sleep(60)

if sys.argv[1] == "workers":
    with fork_map(linger, 4, 2) as results:
        list(results)
elif sys.argv[1] == "a copy":
    with fork_call(linger) as collect:
        collect()
else:
    # Like a compiler, the script starts other processes.
    script = 'touch $1/$$; sh -c "touch $1/\\$\\$; sleep 60; :"; :'
    run_compilers([["sh", "-c", script, "cc", str(folder), "-o", f"{folder}/none"]] * 2, folder)
"""


@pytest.mark.parametrize(("what", "count"), [("workers", 2), ("a copy", 1), ("compilers", 4)])
def test_no_process_outlives_a_killed_parent(what: str, count: int, tmp_path: Path) -> None:
    if what == "compilers" and (os.cpu_count() or 1) < 2:
        count = 2
    process = subprocess.Popen([sys.executable, "-c", KILLED, what, str(tmp_path)], start_new_session=True)
    pids: list[int] = []
    try:
        end = time.monotonic() + 60
        while len(pids) < count and time.monotonic() < end:
            time.sleep(0.02)
            pids = [int(path.name) for path in tmp_path.iterdir()]
        assert len(pids) == count and all(alive(pid) for pid in pids)
        process.kill()
        process.wait()
        assert gone(pids)
    finally:
        for pid in (process.pid, *pids):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


# ---- early end of a run --------------------------------------------------------------------------------------------


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr("impact_posture.system.processes._LATER", [])
    return []


def test_unfinished_blocks_are_undone_newest_first_despite_errors(ended: list[str]) -> None:
    with undone(lambda: ended.append("old")), contextlib.suppress(ZeroDivisionError), undone(lambda: [][1 // 0]):
        with undone(lambda: ended.append("done")):
            pass
        with undone(lambda: ended.append("new")):
            end_early(lambda: ended.append("left"))
    assert ended == ["done", "new", "old", "left", "new", "old"]


def test_a_copy_does_not_undo_blocks_of_the_original(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with undone((tmp_path / "folder").rmdir), fork_call(lambda: end_early(lambda: None)) as collect:
        collect()
        assert (tmp_path / "folder").is_dir()


def test_nothing_ends_the_process_while_signals_are_held(ended: list[str]) -> None:
    with signals_held():
        with signals_held():
            end_early(lambda: ended.append("left"))
        assert ended == []
    assert ended == ["left"]


# ---- fork of this process ------------------------------------------------------------------------------------------


def test_a_copy_has_the_same_state() -> None:
    numbers = np.random.default_rng(5)
    numbers.random(3)

    # A pipe cannot buffer so many numbers, so the child waits until the parent reads them.
    with fork_call(lambda: numbers.random(100_000)) as collect:
        here = numbers.random(100_000)
        np.testing.assert_array_equal(collect(), here)


def test_the_error_of_a_copy_is_raised_here() -> None:
    def fail() -> None:
        raise InputError("is wrong", where="the copy", hint="correct it")

    with fork_call(fail) as collect, pytest.raises(InputError, match="the copy: is wrong; correct it"):
        collect()


def test_a_copy_that_dies_is_an_error() -> None:
    with fork_call(lambda: os.kill(os.getpid(), signal.SIGKILL)) as collect, pytest.raises(WorkerDied):
        collect()


def test_no_copy_outlives_its_block(tmp_path: Path) -> None:
    file = tmp_path / "pid"

    def linger() -> None:
        file.with_suffix(".part").write_text(str(os.getpid()))
        file.with_suffix(".part").replace(file)
        time.sleep(60)

    with pytest.raises(KeyboardInterrupt), fork_call(linger):
        while not file.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert gone([int(file.read_text())], within=1.0)
