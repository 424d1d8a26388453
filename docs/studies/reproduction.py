"""Repeat the experiments of Afifi et al. 2026: their controllers with many seeds, other controllers with few seeds.

Finished runs are stored in build/reproduction, so that an interrupted study can continue.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from docs.studies.core import ROOT, Request, say, table
from impact_posture.experiment.experiment_folders import draw_reproduction
from impact_posture.experiment.job_store import JobStore
from impact_posture.experiment.jobs import Job, execute
from impact_posture.experiment.reproduction import PAPER, Reproduction, controllers_of, reproduce
from impact_posture.experiment.reproduction_summary import (
    LEGEND,
    advice,
    fitted,
    reduction_text,
    remarks,
    scenario_table,
    table_one,
)
from impact_posture.simulation.scenario_file import read_scenario

IMAGES = ROOT / "docs" / "images" / "reproduction"
_SPREAD = (
    "Seed 0 is the scenario as its file states it. Every other seed also changes the start, the speed or force, and "
    "the friction (`[spread]` in the scenario file), so the intervals contain these changes and the sensor noise."
)
# Factors of the shipped gain K of solo8-push.
_GAINS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
# Number of seeds of the controllers that are not in the paper.
OTHERS = 2


def lines(request: Request) -> Iterator[str]:
    """Yield the page.  If the page is written to the documentation, also draw its pictures."""
    scenarios, store = tuple(s for s in PAPER if request.only in s), JobStore(ROOT / "build" / "reproduction")
    shared = {"processes": request.jobs, "store": store, "progress": lambda a, b: say(f"\r{a} of {b} runs", end="")}
    began = time.perf_counter()
    plan = {s: controllers_of(s, False) for s in scenarios}
    main = reproduce(plan, seeds=request.count, **shared)
    say(f"\nthe first part took {time.perf_counter() - began:.0f} s, without the stored runs")
    every = reproduce({s: controllers_of(s, True) for s in scenarios}, seeds=OTHERS, **shared)
    yield "\n\n".join(_parts(main, every))
    if request.write:
        with tempfile.TemporaryDirectory() as folder:
            draw_reproduction(main, store, Path(folder), ["png"])
            _take_shown(Path(folder))


def _take_shown(folder: Path) -> None:
    """Copy the pictures that the documentation shows, and no others."""
    text = (ROOT / "docs" / "reproduction.md").read_text(encoding="utf-8")
    shutil.rmtree(IMAGES, ignore_errors=True)
    for name in re.findall(r"images/reproduction/(\S+\.png)", text):
        (IMAGES / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / name, IMAGES / name)


def _parts(main: Reproduction, every: Reproduction) -> Iterator[str]:
    seeds = ", ".join(str(k) for k in range(main.seeds))
    shown = f"seeds {seeds}; mean ± half of the 95 % confidence interval" if main.seeds > 2 else (
        f"seeds {seeds}; too few for intervals" if main.seeds > 1 else "seed 0 alone: no means, no intervals"
    )  # fmt: skip
    yield from ("### What did best at this point", "\n".join(f"- {line}" for line in advice(main, every)))
    yield from ("### Table I of the paper, and ours", f"`q_total_impact`, {shown}.", table_one(main))
    yield from ("Values that were fitted to the paper:", fitted(main), _SPREAD, LEGEND)
    if "solo8-push" in main.scenarios:
        yield from ("### At which K the quadruped reaches the paper's reduction", *gains(main))
    few = f"means over seeds 0 to {every.seeds - 1}" if every.seeds > 1 else "seed 0"
    for scenario in main.scenarios:
        yield from (f"### {scenario}", scenario_table(main.of(scenario)), f"Every controller, {few}:")
        yield from (scenario_table(every.of(scenario)), " ".join(remarks(every, scenario)))


def gains(main: Reproduction) -> Iterator[str]:
    """Yield a table of the reduction over K for solo8-push, seed 0, and the K that reaches the paper's reduction."""
    name = "solo8-push"
    shipped = read_scenario(name).control.robust.gain
    motion = {}
    for factor in (0.0, *_GAINS):
        job = Job(name, "robust" if factor else "nominal", gain=factor * shipped or None)
        document = execute(job)[1]
        motion[factor] = document["metrics"]["q_total_impact"] if document["metrics"] else math.nan
    reductions = [1 - motion[factor] / motion[0.0] for factor in _GAINS]
    rows = [[f"{f * shipped:g}", f"{100 * r:.1f} %"] for f, r in zip(_GAINS, reductions, strict=True)]
    yield "\n".join(table(["K, 1/s²", "reduction"], rows))
    wanted = PAPER[name].reduction
    reached = [k for k, r in enumerate(reductions) if r >= wanted]
    stiff = main.row(name, "stiff")
    beside = (
        "" if stiff is None else f" `stiff`, as stiff as the term at the shipped K, gives {reduction_text(stiff)}."
    )
    if not reached:
        yield f"No K in this table reaches the paper's reduction of {100 * wanted:.1f} %.{beside}"
    elif (k := reached[0]) == 0:
        yield f"Every K in this table reaches the paper's reduction of {100 * wanted:.1f} %.{beside}"
    else:
        low, high = reductions[k - 1], reductions[k]
        factor = _GAINS[k - 1] + (wanted - low) / (high - low) * (_GAINS[k] - _GAINS[k - 1])
        yield f"The paper's {100 * wanted:.1f} % is reached at K = {factor * shipped:.0f} (interpolated).{beside}"
