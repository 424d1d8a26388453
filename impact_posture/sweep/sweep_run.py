"""Run a sweep on an executor, and write each shard as soon as it is solved."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impact_posture.errors import WorkerDied
from impact_posture.sweep.atlas import Atlas, sweep_key
from impact_posture.sweep.shard import ShardResult, revise_shard, solve_shard
from impact_posture.sweep.shard_table import STATUS
from impact_posture.sweep.sweep_file import Sweep
from impact_posture.system.optional_package import import_extra

Progress = Callable[[int, int], None]
# Maximum number of shards that are submitted and not yet written.  More shards take more memory.  With fewer shards,
# workers may have to wait.
IN_HAND = 64
# If no shard finishes within this time, s, the executor is checked.
_PAUSE = 5.0
# Packages whose errors mean that an executor lost its workers.
_EXECUTORS = ("distributed", "mpi4py", "submitit")


@dataclass(frozen=True)
class SweepRun:
    """Summary of a run of a sweep.

    Attributes:
        folder: Folder of the sweep.
        points: Number of problems of the sweep.
        counts: Number of points of each status in the shards that this run finished.
        shards: Number of shards that this run finished.
        solver_s: Sum of the wall times that the workers spent in IPOPT, s.
        total_s: Sum of the wall times of all shards, s.
        damaged: Files that were damaged or belonged to another sweep, as paths below the folder.  The run replaced
            the files of its own shards.
    """

    folder: Path
    points: int
    counts: dict[str, int]
    shards: int
    solver_s: float
    total_s: float
    damaged: tuple[str, ...]


def run_sweep(
    sweep: Sweep,
    folder: Path,
    executor: Executor | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
    in_hand: int = IN_HAND,
) -> SweepRun:
    """Solve all shards that are missing in the folder, and write them.

    The bytes of a shard do not depend on the executor.

    Args:
        sweep: Sweep to run.
        folder: Folder of the results.  If the folder contains an unfinished run of the same sweep, this run continues
            it.
        executor: A ``concurrent.futures.Executor``; ``None`` to solve in this process.
        force: Whether to replace results of another sweep or version in the folder.
        progress: Callback with the number of solved points and the number of all points to solve.  If shards have two
            passes (:attr:`Sweep.passes`), each point counts twice.
        in_hand: Maximum number of shards that are submitted at the same time.

    Raises:
        InputError: pyarrow is not installed, or a setting is invalid for the robot.
        OutputError: The folder contains other files, or cannot be written.
        WorkerDied: A worker process was killed, or the executor lost its workers.  Run the sweep again to continue
            it.
    """
    import_extra("pyarrow", "sweep")
    key = sweep_key(sweep)
    atlas = Atlas(folder, sweep, key)
    counts, shards, solver_s, total_s = dict.fromkeys(STATUS, 0), 0, 0.0, 0.0
    with atlas.opened(force):
        first, second = atlas.waiting()
        work = [(1, first, lambda shard: (solve_shard, sweep, key, shard)),
                (2, second, lambda shard: (revise_shard, sweep, key, shard, *atlas.solved(shard)))]  # fmt: skip
        points, done = sum(len(sweep.span(shard)[1]) for shard in (*first, *second)), 0
        if progress:
            progress(0, points)
        try:
            for number, waiting, task in work:
                for result in _results(map(task, waiting), executor, in_hand):
                    atlas.write(result.index, result.content, number)
                    solver_s, total_s = solver_s + result.solver_s, total_s + result.total_s
                    done += len(sweep.span(result.index)[1])
                    if number == sweep.passes:
                        shards += 1
                        for status, count in result.counts.items():
                            counts[status] += count
                    if progress:
                        progress(done, points)
        except BrokenExecutor:
            raise WorkerDied("workers") from None
        except Exception as error:
            if not _is_lost(error):
                raise
            raise WorkerDied("workers", f"{type(error).__name__}: {error}".rstrip(": ")) from None
        atlas.finish()
    return SweepRun(folder, sweep.points, counts, shards, solver_s, total_s, tuple(sorted(atlas.damaged)))


def _is_lost(error: Exception) -> bool:
    package = type(error).__module__.partition(".")[0]
    return isinstance(error, CancelledError | ConnectionError | TimeoutError) or package in _EXECUTORS


def _results(tasks: Iterable[tuple[Any, ...]], executor: Executor | None, in_hand: int) -> Iterator[ShardResult]:
    """Yield results of shards in the order in which they finish.  A task is a tuple ``(function, *arguments)``."""
    if executor is None:
        yield from (function(*values) for function, *values in tasks)
        return
    left, pending = iter(tasks), set[Future[ShardResult]]()
    submit_all, check = getattr(executor, "submit_all", None), getattr(executor, "check", None)
    while True:
        batch = [task for _, task in zip(range(in_hand - len(pending)), left, strict=False)]
        if submit_all and batch:
            pending |= set(submit_all(batch))
        else:
            pending |= {executor.submit(*task) for task in batch}
        if not pending:
            return
        finished, pending = wait(pending, _PAUSE if check else None, FIRST_COMPLETED)
        if check and not finished:
            check()
        yield from (future.result() for future in finished)
