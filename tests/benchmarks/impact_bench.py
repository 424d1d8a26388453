"""Do the objectives predict what an impact does?  Random postures meet a stiff surface in MuJoCo.

Run: make study-impacts, or
python -m tests.benchmarks.impact_bench [--robot NAME] [--postures 30] [--seed 0] [--write]
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.errors import ImpactPostureError
from tests.benchmarks.common import machine
from tests.benchmarks.impact.study import CASES, FRICTIONS, VARIATIONS, Case, Choice, Dropped, Row, choices
from tests.benchmarks.impact.surface import Surface
from tests.benchmarks.impact.tables import (
    choice_failure,
    choice_table,
    cone_table,
    convex_line,
    left_out_lines,
    rank_table,
    ratio_table,
    slid_words,
    variation_table,
    verdicts,
)

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "impacts.md"
# Postures of each robot for the table of variations.
_FEW = 10


def main() -> int:
    """Print the tables; with ``--write`` also leave them for the documentation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", choices=[case.robot for case in CASES], help="this one only")
    parser.add_argument("--postures", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help=f"also write {PAGE.name} of the documentation")
    args = parser.parse_args()
    if args.write and args.robot:
        parser.error("--write is for all robots together: leave --robot away")
    if args.postures < 3:
        parser.error("--postures: a rank correlation needs three")
    try:
        version = import_mujoco().__version__
    except ImpactPostureError as error:
        print(error, file=sys.stderr)
        return 1
    began = time.perf_counter()
    cases = [case for case in CASES if args.robot in (None, case.robot)]
    page = "\n".join(study(cases, args.postures, args.seed))
    print(page)
    print(f"{machine()}, MuJoCo {version}; {time.perf_counter() - began:.0f} s")
    if args.write:
        PAGE.write_text(f"<!-- Written by `make study-impacts`; do not edit. -->\n\n{page}", encoding="utf-8")
    return 0


def study(cases: Sequence[Case], postures: int, seed: int) -> list[str]:
    """All tables, as lines of Markdown."""
    dropped = [Dropped.prepare(case, postures, seed) for case in cases]
    rows = [robot.on(Surface(mu)) for robot in dropped for mu in FRICTIONS]
    lasts = max(float(row.measured("duration").max()) for row in rows) * 1e3
    return [
        f"{postures} random postures (seed {seed}) of each robot:",
        "",
        *(f"- `{c.robot}`: {c.words}; `{c.frame}`, n = ({', '.join(f'{v:g}' for v in c.normal)})" for c in cases),
        "",
        f"Approach speed {Surface().speed:g} m/s; no contact lasts longer than {lasts:.2f} ms.",
        "",
        "### Rank correlation of the measured jump with each objective",
        "",
        rank_table(rows),
        slid_words() + ".",
        "",
        *left_out_lines(rows),
        "",
        "### Measured over predicted: median [least, largest]",
        "",
        ratio_table(rows),
        "Targets:",
        "",
        *verdicts(rows),
        "",
        *_which_stick(dropped, rows),
        *_variations(dropped, postures),
        *_picks(cases),
    ]


def _which_stick(dropped: Sequence[Dropped], rows: Sequence[Row]) -> list[str]:
    between = [mu for mu in FRICTIONS if 0 < mu < math.inf]
    convex = [robot.on(Surface(between[0], convex=True)) for robot in dropped]
    return [
        "### Which postures stick",
        "",
        "A posture *should stick* where the friction is at least what its sticking impulse needs: the tangential",
        "part of the impulse over the normal part.",
        "",
        cone_table([row for row in rows if row.surface.friction in between]),
        convex_line([row for row in rows if row.surface.friction == between[0]], convex),
        "",
    ]


def _variations(dropped: Sequence[Dropped], postures: int) -> list[str]:
    few = [replace(robot, scenes=robot.scenes[:_FEW]) for robot in dropped]
    varied = []
    for words, surface in (("as above", Surface()), *VARIATIONS):
        smooth = [robot.on(surface) for robot in few]
        sticky = [robot.on(replace(surface, friction=FRICTIONS[-1])) for robot in few]
        varied.append((words, smooth, sticky))
    lines = ["### Speed, rebound, stiffness", ""]
    lines += [f"The first {min(_FEW, postures)} postures of each robot; the rank is the lowest of the robots'.", ""]
    lines += [variation_table(varied)]
    for words, smooth, sticky in varied:
        gone = [row for row in (*smooth, *sticky) if row.left_out]
        if gone:
            lines += [f"Left out, at {words}:", "", *left_out_lines(gone), ""]
    return lines


def _picks(cases: Sequence[Case]) -> list[str]:
    picked: list[tuple[Case, list[Choice]]] = []
    failures = []
    for case in cases:
        found = choices(case)
        if isinstance(found, ImpactPostureError):
            failures.append(choice_failure(case, found))
        else:
            picked.append((case, found))
    return ["### What each objective picks", "", *([choice_table(picked)] if picked else []), *failures]


if __name__ == "__main__":
    sys.exit(main())
