"""Times and accuracy of the relaxation in C, on relaxed ticks of robots that are pushed until they fall."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from docs.studies.core import Request, machine, one_core, table
from tests.support.relaxation_in_c import BUDGET, SOLVED, Relaxation, missed, stationarity
from tests.support.relaxed_ticks import RUNS, pushed

# Goals for the 99th percentile of the time of a relaxed tick on an idle core, µs.
GOALS = {"tilthex_arm": 15, "solo8": 60, "talos": 300, "g1": 300}
_HEAD = (
    "robot|ticks (before the fall)|median µs|p99 µs|goal|iterations median, p99|"
    "over budget (before the fall)|level 0 missed|distance from the optimum of levels, cost|Python's"
).split("|")


def lines(request: Request) -> Iterator[str]:
    yield from (machine("daqp"), "")
    yield (
        "Processor time of a call, the shortest of ten in five passes, `-O2`; "
        "each starts from the active rows of the tick before.\n"
        f"Over budget: with {request.count} iterations.  Distance: largest relative stationarity residual."
    )
    yield ""
    with one_core(), tempfile.TemporaryDirectory() as folder:
        relaxation = Relaxation(Path(folder), "-O2")
        yield from table(_HEAD, (_row(relaxation, name, request) for name in RUNS if request.only in name))


def _row(relaxation: Relaxation, name: str, request: Request) -> list[str]:
    ticks, standing = pushed(name)
    runs = []
    for _ in range(5):
        relaxation.forget()
        answers = [relaxation.solve(tick, repeats=2) for tick in ticks]
        runs.append([1e6 * answer.seconds for answer in answers])
    relaxation.forget()
    late = np.array([relaxation.solve(tick, budget=request.count).code == BUDGET for tick in ticks])
    times, counts = np.min(runs, axis=0), [answer.iterations for answer in answers]
    distances = np.array([stationarity(tick, answer.z) for tick, answer in zip(ticks, answers, strict=True)])
    theirs = np.array([stationarity(tick, tick.z) for tick in ticks])
    p99, hard = np.percentile(times, 99), max(missed(t, a.z)[0] for t, a in zip(ticks, answers, strict=True))
    if p99 > GOALS[name]:
        request.missed.append(f"{name}: {GOALS[name]} µs")
    if any(answer.code != SOLVED for answer in answers):
        request.missed.append(f"{name}: solved")
    return [
        name,
        f"{len(ticks)} ({standing})",
        f"{np.median(times):.0f}",
        f"{p99:.0f}",
        str(GOALS[name]),
        f"{np.median(counts):.0f}, {np.percentile(counts, 99):.0f}",
        f"{late.mean():.1%} ({late[:standing].mean() if standing else 0.0:.1%})",
        f"{hard:.0e}",
        f"{distances[:, :-1].max():.0e}, {distances[:, -1].max():.0e}",
        f"{theirs[:, :-1].max():.0e}, {theirs[:, -1].max():.0e}",
    ]
