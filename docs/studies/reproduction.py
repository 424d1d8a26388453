"""Repeat the experiments of Afifi et al. 2026: their controllers with many seeds, other controllers with few seeds.

Finished runs are stored in build/reproduction, so that an interrupted study can continue.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from docs.studies.core import ROOT, Request, say
from impact_posture.experiment.experiment_folders import draw_reproduction
from impact_posture.experiment.job_store import JobStore
from impact_posture.experiment.reproduction import PAPER, Reproduction, controllers_of, reproduce
from impact_posture.experiment.reproduction_summary import LEGEND, advice, remarks, scenario_table, table_one

IMAGES = ROOT / "docs" / "images" / "reproduction"
# Number of seeds of the controllers that are not in the paper.
OTHERS = 2


def lines(request: Request) -> Iterator[str]:
    """Yield the page.  If the page is written to the documentation, also draw its pictures."""
    scenarios, store = tuple(s for s in PAPER if request.only in s), JobStore(ROOT / "build" / "reproduction")
    shared = {"processes": request.jobs, "store": store, "progress": lambda a, b: say(f"\r{a} of {b} runs", end="")}
    began = time.perf_counter()
    plan = {s: controllers_of(s, False) for s in scenarios}
    main = reproduce(plan, seeds=request.count, **shared)
    say(f"\nthe first part took {time.perf_counter() - began:.0f} s without the kept runs")
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
    yield from ("### Table I of the paper, and ours", f"`q_total_impact`, {shown}.", table_one(main), LEGEND)
    few = f"means over seeds 0 to {every.seeds - 1}" if every.seeds > 1 else "seed 0"
    for scenario in main.scenarios:
        yield from (f"### {scenario}", scenario_table(main.of(scenario)), f"Every controller, {few}:")
        yield from (scenario_table(every.of(scenario)), " ".join(remarks(every, scenario)))
