"""Run a sweep on an executor, and write each shard when it is done."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impact_posture.errors import WorkerDied
from impact_posture.sweep.atlas import Atlas, check_package, sweep_key
from impact_posture.sweep.shard import ShardResult, revise_shard, solve_shard
from impact_posture.sweep.shard_table import STATUS
from impact_posture.sweep.sweep_file import Sweep

Progress = Callable[[int, int], None]
# Shards that are submitted and not yet written.  More cost memory, fewer leave workers idle.
IN_HAND = 64


@dataclass(frozen=True)
class SweepRun:
    """What a run has done.

    Attributes:
        folder: The sweep folder.
        points: Number of problems of the sweep.
        counts: Number of points of each status in the shards that this run finished.
        shards: Shards that this run finished.
        solver_s: Wall time of the workers within IPOPT, s, added up.
        total_s: Wall time of all shards, s, added up.
    """

    folder: Path
    points: int
    counts: dict[str, int]
    shards: int
    solver_s: float
    total_s: float


def run_sweep(
    sweep: Sweep,
    folder: Path,
    executor: Executor | None = None,
    *,
    progress: Progress | None = None,
    in_hand: int = IN_HAND,
) -> SweepRun:
    """Solve all shards that the folder lacks, and write them.

    The bytes of a shard depend on the sweep alone, and not on what runs it.

    Args:
        sweep: The sweep.
        folder: The folder; an unfinished one of the same sweep is gone on with.
        executor: What runs the shards: anything that implements ``concurrent.futures.Executor``; ``None`` for this
            process.
        progress: Called with the points that are done and all of them, of what was left to do; with several shards a
            case, every point is counted twice.
        in_hand: Most shards that are submitted at once.

    Raises:
        InputError: pyarrow is not installed, or a setting does not fit the robot.
        OutputError: The folder holds something else, or cannot be written.
        WorkerDied: A worker of a pool was killed; another run goes on where this one ended.
    """
    check_package("pyarrow", "sweep")
    key = sweep_key(sweep)
    atlas = Atlas(folder, sweep, key)
    counts, shards, solver_s, total_s = dict.fromkeys(STATUS, 0), 0, 0.0, 0.0
    with atlas.opened():
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
        atlas.finish()
    return SweepRun(folder, sweep.points, counts, shards, solver_s, total_s)


def _results(tasks: Iterable[tuple[Any, ...]], executor: Executor | None, in_hand: int) -> Iterator[ShardResult]:
    """Yield the shards in the order in which they finish; a task is a function and its arguments."""
    if executor is None:
        yield from (function(*values) for function, *values in tasks)
        return
    left, pending = iter(tasks), set[Future[ShardResult]]()
    submit_all = getattr(executor, "submit_all", None)
    while True:
        next_ones = [task for _, task in zip(range(in_hand - len(pending)), left, strict=False)]
        if submit_all and next_ones:
            pending |= set(submit_all(next_ones))
        else:
            pending |= {executor.submit(*task) for task in next_ones}
        if not pending:
            return
        finished, pending = wait(pending, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in finished)
