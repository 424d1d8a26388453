"""Run benchmarks and studies: ``python -m docs.studies NAME … [--only TEXT] [--count N] [--write]``."""

# ruff: noqa: E402 - BLAS counts its threads when numpy is loaded

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import sys

from docs.studies.core import STUDIES, Request, Study, page_of, renewed
from impact_posture.errors import ImpactPostureError
from impact_posture.posture.program.ipopt import one_blas_thread


@one_blas_thread()
def main() -> int:
    """Print the results of each study.  With ``--write``, also write the page of the study into the documentation."""
    listed = "\n".join(f"  {study.name:13}{study.about}" for study in STUDIES.values())
    parser = argparse.ArgumentParser(
        prog="python -m docs.studies", description=f"benchmarks and studies:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("names", nargs="+", choices=list(STUDIES), metavar="NAME")
    parser.add_argument("--only", default="", metavar="TEXT", help="run only cases whose name contains TEXT")
    parser.add_argument("--count", type=int, help="number of starts, ticks, passes, postures, draws or seeds")
    parser.add_argument("--seed", type=int, default=0, help="seed of impacts and points; first of four seeds of flow")
    parser.add_argument("--number", type=int, help="points: repeat and print only this point")
    parser.add_argument("--jobs", type=int, default=2, help="number of processes for points and reproduction")
    parser.add_argument("--against", default="", metavar="PROGRAM", help="answer: another impact-posture to compare")
    parser.add_argument("--data", default="", metavar="FOLDER", help="hits: folder of the recordings")
    parser.add_argument("--write", action="store_true", help="also write the page in docs/generated")
    asked = parser.parse_args()
    wanted = [STUDIES[name] for name in asked.names]
    if asked.write and (asked.number is not None or not all(study.page for study in wanted)):
        parser.error("--write is for studies that have a page")
    if asked.write and asked.only and not all(study.parts for study in wanted):
        parser.error("--write is for all cases of this study: leave out --only")
    if asked.count is not None and asked.count < 1:
        parser.error("--count: one or more")
    return max([_run(study, asked) for study in wanted])


def _run(study: Study, asked: argparse.Namespace) -> int:
    request = Request(
        asked.only, asked.count or study.count, asked.seed, asked.number, asked.jobs, asked.write, asked.against,
        asked.data,
    )  # fmt: skip
    lines = [study.head, ""]
    try:
        for line in study.lines(request):
            print(line, flush=True)
            lines.append(line)
    except ImpactPostureError as error:
        print(error, file=sys.stderr)
        return 1
    if asked.write:
        page, text = page_of(study.name), "\n".join([*lines, ""])
        page.write_text(renewed(page.read_text(encoding="utf-8"), text) if asked.only else text, encoding="utf-8")
    for word in request.missed:
        print(f"missed: {word}", file=sys.stderr)
    return int(bool(request.missed))


if __name__ == "__main__":
    sys.exit(main())
