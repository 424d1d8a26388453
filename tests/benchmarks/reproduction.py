"""The paper's experiments for the documentation: its controllers over many seeds, every controller over a few.

Run: make reproduction, or
python -m tests.benchmarks.reproduction [--seeds 10] [--others 2] [--jobs 2] [--write]

Runs that are done are kept in build/reproduction; run it again after an interruption.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

from impact_posture.errors import ImpactPostureError
from impact_posture.experiment.batch import Store
from impact_posture.experiment.figures import draw_reproduction
from impact_posture.experiment.paper import PAPER
from impact_posture.experiment.reproduction import Reproduction, controllers_of, jobs_of, reproduce
from impact_posture.experiment.reproduction_summary import LEGEND, advice, remarks, scenario_table, table_one

ROOT = Path(__file__).parents[2]
PAGE, IMAGES = ROOT / "docs" / "generated" / "reproduction.md", ROOT / "docs" / "images" / "reproduction"


def main() -> int:
    """Run, print, and with ``--write`` leave page and pictures for the documentation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="of nominal, robust and the recommended controller")
    parser.add_argument("--others", type=int, default=2, help="seeds of all controllers")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--write", action="store_true", help="write docs/generated and docs/images")
    args = parser.parse_args()
    store, plan = Store(ROOT / "build" / "reproduction"), {s: controllers_of(s, False) for s in PAPER}
    began = time.perf_counter()
    try:
        shared = {"processes": args.jobs, "store": store, "progress": _say}
        main_rows = reproduce(plan, seeds=args.seeds, **shared)
        took = time.perf_counter() - began
        every = reproduce({s: controllers_of(s, True) for s in PAPER}, seeds=args.others, **shared)
    except ImpactPostureError as error:
        print(error, file=sys.stderr)
        return 1
    page = "\n\n".join(_page(main_rows, every)) + "\n"
    print(f"\n{page}\nthe first part took {took:.0f} s with {args.jobs} processes, less what was kept")
    if args.write:
        PAGE.write_text(f"<!-- Written by `make reproduction`; do not edit. -->\n\n{page}", encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder:
            draw_reproduction(main_rows, jobs_of(plan, seeds=1), store, Path(folder), ["png"])
            _take_shown(Path(folder))
    return 0


def _take_shown(folder: Path) -> None:
    """The pictures that the documentation shows; the others stay away from the repository."""
    text = (ROOT / "docs" / "reproduction.md").read_text(encoding="utf-8")
    shutil.rmtree(IMAGES, ignore_errors=True)
    for name in re.findall(r"images/reproduction/(\S+\.png)", text):
        (IMAGES / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(folder / name, IMAGES / name)


def _page(found: Reproduction, every: Reproduction) -> list[str]:
    seeds = ", ".join(str(k) for k in range(found.seeds))
    shown = f"seeds {seeds}; mean ± half of the 95 % confidence interval" if found.seeds > 2 else (
        f"seeds {seeds}; too few for intervals" if found.seeds > 1 else "seed 0 alone: no means, no intervals"
    )  # fmt: skip
    parts = [
        "## What to choose",
        "\n".join(f"- {line}" for line in advice(found, every)),
        "## Table I of the paper, and ours",
        f"`q_total_impact`, {shown}.",
        table_one(found),
        LEGEND,
    ]
    for scenario in found.scenarios:
        few = f"means over seeds 0 to {every.seeds - 1}" if every.seeds > 1 else "seed 0"
        parts += [
            f"## {scenario}",
            scenario_table(found.of(scenario)),
            f"Every controller, {few}:",
            scenario_table(every.of(scenario)),
            " ".join(remarks(every, scenario)),
        ]
    return parts


def _say(done: int, total: int) -> None:
    print(f"\r{done} of {total} runs", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
