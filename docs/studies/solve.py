"""Time to build and solve problems with feet, cones and other options, and time of the exported gradient."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from unittest.mock import patch

from docs.studies.cases import CASES, Case
from docs.studies.core import Request, Vector, cell, crba_time, feasible_starts, machine, table
from docs.studies.exported import feet
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.posture_nlp import PostureNLP, build_nlp
from impact_posture.posture.search.growing_search import run_start
from impact_posture.system.toolchain import find_compiler

# Goals for the time of a solve from one start, ms.
TARGETS_MS = {
    "tilthex_arm": 5, "tilthex_arm, ahead": 5, "panda": 5, "tilthex_arm, cone 5°": 10, "tilthex_arm, cone 20°": 10,
    "tilthex_arm, cone 45°": 10, "solo8, four feet": 30, "solo8, four feet, cone 20°": None, "talos, two feet": 50,
    "talos, two feet, cone 5°": 150, "talos, two feet, cone 20°": 150, "talos at the torso, two feet, cone 20°": 150,
    "talos, both hands": None, "solo12, two feet struck": None, "tilthex_arm, 6 models": None,
    "talos, two feet, 3 models": None,
}  # fmt: skip
_HEAD = "case|unknowns|mode|build s|processor s|again s|solve ms|processor ms|× `crba`|iterations|certified|target ms"


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each case and compile mode, then times of the exported gradient with feet and without."""
    yield (
        f"{machine()}; medians of {request.count} random feasible starts, one at a time; × `crba` compares processor "
        "time. `again`: with the cache that the first build filled."
    )
    yield ""
    yield from table(_HEAD.split("|"), _rows(request))
    yield ""
    yield from feet(request)


def _rows(request: Request) -> Iterator[list[str]]:
    for case in (CASES[name] for name in TARGETS_MS if request.only in name):
        problem = case.problem()
        starts = feasible_starts(problem, request.count, seed=1)
        for mode in ("interpreted", "compiled") if find_compiler() else ("interpreted",):
            yield _row(case, problem, starts, mode)


def _row(case: Case, problem: ConstrainedProblem, starts: Sequence[Vector], mode: str) -> list[str]:
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, IMPACT_POSTURE_CACHE=folder):
        nlp, cold, busy_building = _built(problem, mode)
        nlp, again, _ = _built(problem, mode)
    scale = problem.objective.value(problem.given)
    runs, times = [], list[float]()
    for start in starts:
        began = time.process_time()
        runs.append(run_start(nlp, start, scale))
        times.append(time.process_time() - began)
    wall, busy = statistics.median(record.time_s for record, _ in runs), statistics.median(times)
    return [
        case.name,
        str(nlp.solver.size1_in("x0")),
        mode,
        f"{cold:.1f}",
        f"{busy_building:.1f}",
        f"{again:.2f}",
        f"{wall * 1e3:.1f}",
        f"{busy * 1e3:.1f}",
        f"{busy / crba_time(problem.robot.model):.0f}",
        f"{statistics.median(record.iterations for record, _ in runs):.0f}",
        f"{sum(certificate.holds() for _, certificate in runs)}/{len(runs)}",
        cell(TARGETS_MS[case.name], 0),
    ]


def _built(problem: ConstrainedProblem, mode: str) -> tuple[PostureNLP, float, float]:
    """Build the program; return the program, the wall time and the processor time, s, including the compiler."""
    began, busy = time.perf_counter(), sum(os.times()[:4])
    nlp = build_nlp(problem, compile="never" if mode == "interpreted" else "always")
    return nlp, time.perf_counter() - began, sum(os.times()[:4]) - busy
