"""A sweep whose workers, jobs or scheduler are killed continues, or gives one error line and keeps its shards.

``--hostile-full`` kills a Dask scheduler, Dask workers, MPI ranks and local jobs of submitit.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import signal
import socket
import sys
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future
from pathlib import Path
from types import SimpleNamespace

import pytest

from impact_posture.errors import WorkerDied
from impact_posture.sweep import executors, sweep_run
from impact_posture.sweep.sweep_file import read_sweep
from impact_posture.sweep.sweep_run import run_sweep
from tests.hostile.arena import Outcome
from tests.hostile.disturbed_sweeps import COMMAND, check, interrupted, running

ERRORS: tuple[Callable[[], BaseException], ...] = (
    CancelledError, TimeoutError, ConnectionResetError,
    lambda: importlib.import_module("distributed.comm").CommClosedError("in <TCP>: Stream is closed"),
    lambda: importlib.import_module("submitit.core.utils").UncompletedJobError("Job 1 has not produced any output"),
)  # fmt: skip


class Failing(Executor):
    """Executor that solves one shard, and then fails."""

    def __init__(self, error: BaseException, *, at_submit: bool) -> None:
        self.error, self.at_submit, self.count = error, at_submit, 0

    def submit(self, function: Callable[..., object], /, *arguments: object, **named: object) -> Future[object]:
        self.count += 1
        future: Future[object] = Future()
        if self.count == 1:
            future.set_result(function(*arguments, **named))
        elif self.at_submit:
            raise self.error
        else:
            future.set_exception(self.error)
        return future


@pytest.mark.parametrize("at_submit", [False, True], ids=["result", "submit"])
@pytest.mark.parametrize("k", range(len(ERRORS)))
def test_errors_of_executors(k: int, at_submit: bool, sweep: Path, tmp_path: Path) -> None:
    for package in ("distributed", "submitit"):
        pytest.importorskip(package)
    with pytest.raises(WorkerDied, match="run the command again to continue"):
        run_sweep(read_sweep(sweep), tmp_path / "out", Failing(ERRORS[k](), at_submit=at_submit), in_hand=1)
    assert len(list((tmp_path / "out").rglob("*.parquet"))) == 1


class Stopped(Executor):
    """Executor that never solves a shard, and whose check fails at its second call."""

    checks = 0

    def submit(self, function: Callable[..., object], /, *arguments: object, **named: object) -> Future[object]:
        return Future()

    def check(self) -> None:
        self.checks += 1
        if self.checks == 2:
            raise TimeoutError("tcp://host has not answered for 30 s")


def test_an_executor_that_does_not_answer(sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_run, "_PAUSE", 0.01)
    with pytest.raises(WorkerDied, match=r"tcp://host has not answered for 30 s\); check them, and run the command"):
        run_sweep(read_sweep(sweep), tmp_path / "out", Stopped())


def test_a_dask_cluster_loses_all_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "_WITHOUT_WORKERS", 0)
    answers = iter([{}, {"tcp://worker": 1}, {}])
    scheduler = SimpleNamespace(ncores=None)
    client = SimpleNamespace(get_executor=lambda: None, scheduler=scheduler, sync=lambda *_, **__: next(answers))
    workers = executors.DaskWorkers(client, "tcp://host:1")
    workers.check()  # the cluster may wait for its first worker
    workers.check()
    with pytest.raises(TimeoutError, match="tcp://host:1 has had no workers for 0 s"):
        workers.check()


@pytest.mark.parametrize("victim", ["scheduler", "worker", "all workers", "stopped scheduler", "stopped, Ctrl-C"])
def test_a_dask_cluster_is_killed(victim: str, sweep: Path, tmp_path: Path, hostile_full: bool) -> None:
    if not hostile_full:
        pytest.skip("a Dask cluster: give --hostile-full")
    pytest.importorskip("distributed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = (sys.executable, "-m")
    scheduler = (*dask, "distributed.cli.dask_scheduler", "--no-dashboard", "--host", "127.0.0.1", "--port", port)
    worker = (*dask, "distributed.cli.dask_worker", address, "--no-dashboard", "--no-nanny", "--nthreads", 1,
              "--local-directory", tmp_path / "dask")  # fmt: skip
    with running(*scheduler) as first, running(*worker) as second, running(*worker) as third:
        killed = {"worker": [second], "all workers": [second, third]}.get(victim, [first])

        def harm(pid: int) -> None:
            for process in killed:
                os.killpg(process.pid, signal.SIGSTOP if "stopped" in victim else signal.SIGKILL)
            if victim in ("all workers", "stopped, Ctrl-C"):
                os.killpg(pid, signal.SIGINT)

        outcome = interrupted([*COMMAND, "sweep", str(sweep), "--scheduler", address], tmp_path / "out", harm)
    assert outcome.code == {"worker": 0, "all workers": 130, "stopped, Ctrl-C": 130}.get(victim, 1), outcome.err
    check(outcome, sweep, tmp_path / "out")


@pytest.mark.parametrize("victim", ["jobs", "parent"])
def test_local_jobs_are_killed(victim: str, sweep: Path, tmp_path: Path, hostile_full: bool) -> None:
    if not hostile_full:
        pytest.skip("jobs of submitit: give --hostile-full")
    pytest.importorskip("submitit")
    program = (
        "from impact_posture.sweep import slurm_jobs\nfrom impact_posture_cli.main import main\n"
        "jobs = slurm_jobs.SlurmJobs\n"
        "slurm_jobs.SlurmJobs = lambda folder, options: jobs(folder, options, 'local')\nmain()\n"
    )

    def harm(pid: int) -> None:
        if victim == "parent":
            os.killpg(pid, signal.SIGTERM)
            return
        end = time.monotonic() + 3
        while time.monotonic() < end:
            for entry in Path("/proc").iterdir():
                with contextlib.suppress(OSError, ValueError):
                    command = (entry / "cmdline").read_text()
                    if "submitit" in command and str(tmp_path) in command:
                        os.kill(int(entry.name), signal.SIGKILL)
            time.sleep(0.05)

    words = [sys.executable, "-c", program, "sweep", str(sweep), "--slurm", "timeout_min=5"]
    outcome = interrupted(words, tmp_path / "out", harm)
    assert outcome.code in ((143,) if victim == "parent" else (0, 1)), outcome.err
    check(outcome, sweep, tmp_path / "out")


def test_an_mpi_rank_is_killed(sweep: Path, tmp_path: Path, hostile_full: bool) -> None:
    """MPI itself ends all ranks, so only the shards are checked."""
    if not hostile_full:
        pytest.skip("MPI ranks: give --hostile-full")
    mpiexec = shutil.which("mpiexec")
    if mpiexec is None:
        pytest.skip("no mpiexec")
    pytest.importorskip("mpi4py", reason="mpi4py is not installed (the extra 'mpi')")

    def harm(pid: int) -> None:
        ranks = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError):
                if (
                    "mpi4py.futures" in (entry / "cmdline").read_text()
                    and str(tmp_path) in (entry / "cmdline").read_text()
                ):
                    ranks.append(int(entry.name))
        os.kill(max(ranks), signal.SIGKILL)

    words = [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", *COMMAND[1:], "sweep", str(sweep), "--mpi"]
    outcome = interrupted(words, tmp_path / "out", harm, OMPI_MCA_rmaps_base_oversubscribe="1")
    assert outcome.code and "Traceback" not in outcome.err, outcome.err
    check(Outcome((), 0, "", "", ()), sweep, tmp_path / "out")
