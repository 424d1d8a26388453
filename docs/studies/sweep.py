"""Robustness and computation time of sweeps.  Run with ``make study-sweep``.

Four runs must write the same bytes as a process pool: on a Dask cluster that loses a worker, on MPI ranks, with local
Slurm jobs, and with a main process that is killed at random times.  The study then measures the speed, the memory of
a long run, and the overhead of a task.  ``python -m docs.studies.sweep FOLDER ROBOT POINTS`` starts or continues a
large sweep.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.sweep.atlas import open_atlas
from impact_posture.sweep.executors import dask_cluster
from impact_posture.sweep.slurm_jobs import SlurmJobs
from impact_posture.sweep.sweep_file import Sweep, read_sweep
from impact_posture.sweep.sweep_run import SweepRun, run_sweep
from impact_posture.system.processes import process_pool

KILLS = 20
SMALL = """
shard = 20
[problem]
robot = "tilthex_arm"
normal = [0, 0, 1]
[grid]
normal = [[0, 0, 1], [0, 0.2, 1], [0, 0.4, 1], [0.2, 0, 1], [0.4, 0, 1], [0.3, 0.3, 1]]
x = { from = -0.1, to = 0.1, count = 10 }
z = { from = -0.1, to = 0.1, count = 10 }
"""
TALOS = """
shard = 16
[problem]
robot = "talos"
frame = "gripper_right_base_link"
normal = [-1, 0, 0]
starts = 4
[grid]
x = { from = -0.15, to = 0.15, count = COUNT }
z = { from = -0.15, to = 0.15, count = COUNT }
"""


def tilted(count: int) -> str:
    """Return a sweep for the aerial manipulator: ``count`` tilts of the surface times ``count`` tilts of the tool."""
    tilts = [(k / (count - 1) - 0.5, 3.1 * k / (count - 1) - 1.35) for k in range(count)]
    normals = [[0.0, math.sin(tilt), math.cos(tilt)] for tilt, _ in tilts]
    turns = [[math.cos(tilt / 2), 0.0, -math.sin(tilt / 2), 0.0] for _, tilt in tilts]
    return f'[problem]\nrobot = "tilthex_arm"\n[grid]\nnormal = {normals}\ntarget_quaternion = {turns}\n'


def shards(folder: Path) -> dict[str, bytes]:
    """Return the content of each data file of a sweep folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.glob("data/*/*.parquet"))}


def command(*words: object) -> list[str]:
    """Return a command line that runs ``impact-posture`` of this installation."""
    return [sys.executable, str(Path(sys.executable).with_name("impact-posture")), *map(str, words)]


def killed_dask_worker(sweep: Sweep, folder: Path) -> None:
    """Run the sweep on a local Dask cluster of four workers, and kill one worker during the run."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=4, threads_per_worker=1, dashboard_address=None) as cluster:
        victim = next(iter(cluster.workers.values())).pid
        halfway = threading.Event()

        def progress(done: int, count: int) -> None:
            if done >= count // 4 and not halfway.is_set():
                os.kill(victim, signal.SIGKILL)
                halfway.set()

        with dask_cluster(cluster.scheduler_address) as executor:
            run_sweep(sweep, folder, executor, progress=progress)
        assert halfway.is_set()


def mpi_ranks(file: Path, folder: Path) -> None:
    """Run the sweep on three MPI ranks.  The first rank is the main process."""
    mpiexec = shutil.which("mpiexec", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if mpiexec is None:
        raise FileNotFoundError("no mpiexec")
    words = command("sweep", file, "--mpi", "--out", folder)
    launched = [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", *words[1:]]
    # Open MPI by default allows no more ranks than cores, and the machine may have two cores.
    environment = os.environ | {"OMPI_MCA_rmaps_base_oversubscribe": "1"}
    subprocess.run(launched, check=True, capture_output=True, timeout=900, env=environment)


def slurm_jobs(sweep: Sweep, folder: Path) -> None:
    """Run the sweep as local jobs of submitit on this machine."""
    with SlurmJobs(folder.with_name("slurm-logs"), {"timeout_min": 30}, "local") as executor:
        run_sweep(sweep, folder, executor, in_hand=4)


def slurm_cluster(file: Path, folder: Path) -> None:
    """Run the sweep as job arrays on the Slurm cluster of this machine."""
    if shutil.which("sbatch") is None:
        raise FileNotFoundError("no sbatch")
    words = command("sweep", file, "--slurm", "timeout_min=30", "--out", folder)
    subprocess.run(words, check=True, capture_output=True, timeout=900)


def killed_parent(file: Path, folder: Path, seed: int) -> int:
    """Kill a run KILLS times, each at a random time after a new shard, and continue; return the number of kills."""
    rng, kills = random.Random(seed), 0
    while True:
        before = len(shards(folder))
        words = ("sweep", file, "--quiet", "--workers", rng.choice((1, 2)), "--out", folder)
        child = subprocess.Popen(command(*words), start_new_session=True)
        while kills < KILLS and child.poll() is None:
            if len(list(folder.glob("data/*/*.parquet"))) > before:
                time.sleep(rng.uniform(0.0, 1.0))
                child.kill()
                kills += child.wait() == -signal.SIGKILL
            time.sleep(0.01)
        if child.wait() == 0:
            if kills >= KILLS:
                return kills
            # The run ended before it was killed often enough: remove some shards, and continue.
            for path in sorted(folder.glob("data/*/*.parquet"))[::2]:
                path.unlink()


def robustness(folder: Path, only: str = "") -> None:
    """Compare the files that all executors write with the files of the process pool."""
    file = folder / "small.toml"
    file.write_text(SMALL)
    sweep = read_sweep(file)
    with process_pool(2) as pool:
        run_sweep(sweep, folder / "pool", pool)
    wanted = shards(folder / "pool")
    executors: dict[str, Callable[[Path], object]] = {
        "Dask, 4 workers, one killed": lambda out: killed_dask_worker(sweep, out),
        "MPI, 3 ranks": lambda out: mpi_ranks(file, out),
        "submitit, local jobs": lambda out: slurm_jobs(sweep, out),
        "submitit, job arrays of Slurm": lambda out: slurm_cluster(file, out),
        f"parent killed {KILLS} times": lambda out: killed_parent(file, out, 1),
    }
    for k, (name, execute) in enumerate(executors.items()):
        if only and only not in name:
            continue
        out = folder / f"executor-{k}"
        try:
            execute(out)
        except (ImportError, FileNotFoundError, subprocess.CalledProcessError) as error:
            print(f"{name}: not run ({error} {getattr(error, 'stderr', b'')[-300:]!r})")
            continue
        same = shards(out) == wanted
        print(f"{name}: {len(shards(out))} shards, {'same bytes as the pool' if same else 'OTHER BYTES'}", flush=True)


def speed(folder: Path, points: int) -> None:
    """Measure the share of time in the solver, the memory of this process, and the speedup by a second process."""
    file = folder / "long.toml"
    file.write_text(SMALL.replace("count = 10", f"count = {max(2, round((points / 6) ** 0.5))}").replace("20", "256"))
    sweep, seen = read_sweep(file), list[tuple[int, float]]()

    def progress(done: int, count: int) -> None:
        seen.append((done, _resident()))

    result: SweepRun = run_sweep(sweep, folder / "long", progress=progress)
    solved = sum(result.counts.values())
    share, each = result.solver_s / result.total_s, 1e3 * result.total_s / solved
    print(f"{solved} problems: {each:.2f} ms each, {100 * share:.1f} % of it within IPOPT")
    late = seen[len(seen) // 3 :]
    slope = (late[-1][1] - late[0][1]) / max(1, late[-1][0] - late[0][0]) * 1e3
    print(
        f"resident memory {late[0][1]:.1f} to {late[-1][1]:.1f} MB over the last two thirds: {slope:+.2f} MB per 1000"
    )
    size = sum(path.stat().st_size for path in (folder / "long" / "data").rglob("*.parquet"))
    print(f"{size / solved:.0f} bytes a problem")
    began = time.perf_counter()
    with process_pool(2) as pool:
        run_sweep(sweep, folder / "two", pool)
    # ``alone`` is the speed of the first run without the time of storing shards.
    alone, together = solved / result.total_s, solved / (time.perf_counter() - began)
    share = together / (2 * alone)
    print(f"the search alone {alone:.0f} a second, the sweep with two workers {together:.0f}: {100 * share:.0f} %")


def _resident(process: int | str = "self") -> float:
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Watched(Executor):
    """Executor that runs tasks on a pool and records the times of the shards.

    Args:
        pool: Pool that runs the tasks.

    Attributes:
        finished: Processor time inside IPOPT and total processor time of each finished shard, s.
    """

    def __init__(self, pool: Executor) -> None:
        self._pool, self.finished = pool, list[tuple[float, float]]()

    def submit(self, *task: Any, **options: Any) -> Future[Any]:
        future = self._pool.submit(*task, **options)
        future.add_done_callback(lambda f: self.finished.append((f.result().solver_s, f.result().total_s)))
        return future


def atlas(folder: Path, name: str, points: int) -> None:
    """Start or continue a large sweep with two processes, and print times and results."""
    folder.mkdir(parents=True, exist_ok=True)
    file, count = folder / f"{name}.toml", math.isqrt(points - 1) + 1
    file.write_text(tilted(count) if name == "tilthex_arm" else TALOS.replace("COUNT", str(count)))
    sweep, began, told = read_sweep(file), time.perf_counter(), 0

    def progress(done: int, count: int) -> None:
        nonlocal told
        if done * 10 // count == told and done < count:
            return
        told = done * 10 // count
        within, total = np.sum(watched.finished, axis=0) if watched.finished else (0.0, 1.0)
        children = [child.pid for child in multiprocessing.active_children()]
        memory = " ".join(f"{_resident(pid):.1f}" for pid in children if pid)
        spent = f"{1e3 * total / max(1, done):.2f} ms each, {100 * within / total:.1f} % of it within IPOPT"
        print(f"{name}: {done} of {count}, {spent}, resident memory {memory} MB", flush=True)

    with process_pool(2) as pool:
        watched = Watched(pool)
        result = run_sweep(sweep, folder / name, watched, progress=progress, in_hand=4)
    solved, took = sum(result.counts.values()), time.perf_counter() - began
    print(f"{name}: {solved} of {result.points} problems in this run, {took:.0f} s, {solved / took:.1f} a second")
    table = open_atlas(folder / name).to_table(columns=["status", "reason"]).to_pylist()
    for status, count in Counter(row["status"] for row in table).most_common():
        print(f"{status}: {count} ({100 * count / len(table):.1f} %)")
    conflicts = Counter(row["reason"].partition(" (off by")[0] for row in table if row["reason"])
    for reason, count in conflicts.most_common(8):
        print(f"  {count} × {reason} first")


def task_overhead() -> None:
    """Measure the time that an executor needs for an empty task."""

    def each(executor: Executor, count: int) -> float:
        list(executor.map(len, [""] * 20))
        began = time.perf_counter()
        list(executor.map(len, [""] * count))
        return 1e3 * (time.perf_counter() - began) / count

    with process_pool(2) as pool:
        print(f"overhead of a task, pool: {each(pool, 2000):.2f} ms")
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        dask_cluster(cluster.scheduler_address) as executor,
    ):
        print(f"overhead of a task, Dask: {each(executor, 2000):.2f} ms")


if __name__ == "__main__":
    if len(sys.argv) == 4:
        atlas(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
        sys.exit()
    with tempfile.TemporaryDirectory() as place:
        for part in sys.argv[1:] or ["robustness", "speed", "overhead"]:
            if part == "speed":
                speed(Path(place), 2000)
            elif part == "overhead":
                task_overhead()
            else:
                # The argument is a word from the name of an executor, such as MPI.
                robustness(Path(place), "" if part == "robustness" else part)
