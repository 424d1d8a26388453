"""H and ∇H side by side, every column: what ``impact-posture bench`` measures, and the page of the documentation.

Columns: H with ∇H, its ratio to the fastest of ours, H alone, how many times that H with ∇H is, ours over a batch per
configuration; arithmetic of H with ∇H on single numbers, and of ours the operations that vectors make of it; the
source file and what H with ∇H takes of it; processor seconds of the compiler for the whole file.

Run: python -m tests.benchmarks.kernel_times [--robot NAME] [--peers pinocchio,adam,casadi] [--rounds N] [--write]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from impact_posture.benchmark.measure import DEFAULT_ROBOTS, PEERS, machine, measure
from impact_posture.benchmark.report import BenchReport, BenchRow, Comparison, commands
from impact_posture.robot.robot_loader import load_robot

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "kernel.md"


def main() -> None:
    """Print one table a robot; with ``--write`` renew the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--robot", choices=DEFAULT_ROBOTS, action="append", help="repeatable; all of them by default")
    parser.add_argument("--peers", default=",".join(PEERS), help="comma-separated; empty for ours alone")
    parser.add_argument("--rounds", type=int, default=101)
    parser.add_argument("--patience", type=float, default=600.0, help="seconds that a compiler may take")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name} of the documentation")
    asked = parser.parse_args()
    wanted = [name for name in PEERS if name in asked.peers.split(",")]
    for name in filter(None, asked.peers.split(",")):
        if name not in PEERS:
            parser.error(f"no peer {name}: {', '.join(PEERS)}")
    about = machine()
    print(", ".join(f"{key} {value}" for key, value in about.items()))
    reports = []
    for name in asked.robot or DEFAULT_ROBOTS:
        robot = load_robot(name)
        frame = robot.spec.contact.frame or ""
        said = f"{name}: {{}}\n".format
        found = measure(robot, frame, wanted, asked.rounds, asked.patience, lambda t, s=said: _log(s(t)))
        reports.append(found)
        _table(found)
    for flags, rows in commands(reports).items():
        print(f"$ {flags}  # {', '.join(rows)}")
    if asked.write:
        PAGE.write_text(_page(about, reports), encoding="utf-8")


def _log(text: str) -> None:
    sys.stderr.write(text)


# ---- terminal -----------------------------------------------------------------------------------------------------

_HEADS = " H, ∇H µs  ratio    H µs   ∇/H  batch    ops    mul    add  div trig packed    kB of it compile s"


def _table(report: BenchReport) -> None:
    print(
        f"\n{report.robot} at {report.frame}: nq {report.nq}, nv {report.nv}, {report.configurations} configurations,"
        f" core {report.core}"
    )
    width = max(len(row.name) for row in report.rows)
    print(f"  {'':{width}} {_HEADS}")
    for row in report.rows:
        done = row.operations
        counts = (done.total, done.mul, done.add, done.div, done.trig, done.packed) if done else (None,) * 6
        cells = [
            _cell(row.eval_us, 9, 3),
            _cell(row.ratio, 6, 2),
            _cell(row.value_us, 7, 3),
            _cell(_times_H(row), 5, 2),
            _cell(row.batch_us, 6, 3),
            *[_cell(c, w, 0) for c, w in zip(counts, (6, 6, 6, 4, 4, 6), strict=True)],
            *[_cell(kb, 5, 0) for kb in (row.source_kb, row.eval_kb)],
            _cell(row.compile_s, 9, 1),
        ]
        print(f"  {row.name:{width}} {' '.join(cells)}")
    if report.floor is not None:
        least = report.floor
        print(f"  {'floor (articulated bodies + adjoint, by count)':{width + 38}}"
              f" {least.total:6} {least.mul:6} {least.add:6} {least.div:4} {least.trig:4}")  # fmt: skip
    for row in report.rows:
        print(f"  {row.name}: {row.what}; differs from the oracle by {row.difference:.0e}")
    for line in (*_compared(report), *_left_out(report)):
        print(f"  {line}")


def _times_H(row: BenchRow) -> float | None:
    return row.eval_us / row.value_us if row.value_us is not None else None


def _cell(value: float | None, width: int, digits: int) -> str:
    return f"{value:{width}.{digits}f}" if value is not None else f"{'-':>{width}}"


def _compared(report: BenchReport) -> list[str]:
    return [f"{c.eval:.1f} × faster than {c.words} ({c.row}); a configuration of a batch {c.batch:.1f} ×"
            for c in report.comparisons]  # fmt: skip


def _left_out(report: BenchReport) -> list[str]:
    return [*[f"{left.name}: skipped, {left.reason}" for left in report.skipped], *report.notes]


# ---- page ---------------------------------------------------------------------------------------------------------


def _page(about: dict[str, str | int | float | None], reports: list[BenchReport]) -> str:
    lines = [
        "<!-- Written by `python -m tests.benchmarks.kernel_times --write`; do not edit. -->",
        "",
        f"{about['processor']} ({about['architecture']}), one core; {about['compiler']}; CasADi {about['casadi']}, "
        f"Pinocchio {about['pinocchio']}; medians of {reports[0].rounds} passes over "
        f"{reports[0].configurations} random configurations.",
        "",
        "| how many times faster H with ∇H is than | " + " | ".join(f"{r.robot} (nv {r.nv})" for r in reports) + " |",
        "|---|" + "---|" * len(reports),
    ]
    for words in dict.fromkeys(c.words for r in reports for c in r.comparisons):
        found = [next((c for c in r.comparisons if c.words == words), None) for r in reports]
        lines.append(f"| {words} | " + " | ".join(_both(c) for c in found) + " |")
    lines += ["", "In brackets: a configuration of a batch, on the same core."]
    for report in reports:
        lines += ["", *_markdown(report)]
    lines += ["", "Made by:", "", "| rows | compiler and options |", "|---|---|"]
    lines += [f"| {', '.join(rows)} | `{flags}` |" for flags, rows in commands(reports).items()]
    return "\n".join([*lines, ""])


def _both(comparison: Comparison | None) -> str:
    return "–" if comparison is None else f"{comparison.eval:.1f} ({comparison.batch:.1f})"


def _markdown(report: BenchReport) -> list[str]:
    lines = [
        f"**{report.robot}** at `{report.frame}`: nq {report.nq}, nv {report.nv}",
        "",
        "| way | H, ∇H µs | ratio | H µs | ∇/H | batch µs | operations | packed | source kB | build s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in report.rows:
        done = row.operations
        cells = [
            _plain(row.eval_us, 3), _plain(row.ratio, 2), _plain(row.value_us, 3), _plain(_times_H(row), 2),
            _plain(row.batch_us, 3), *[_plain(n, 0) for n in ((done.total, done.packed) if done else (None, None))],
            _plain(row.source_kb, 0), _plain(row.compile_s, 1),
        ]  # fmt: skip
        lines.append(f"| {row.name} | " + " | ".join(cells) + " |")
    if report.floor is not None:
        lines.append(f"| floor | – | – | – | – | – | {report.floor.total} | – | – | – |")
    left = _left_out(report)
    return [*lines, *(["", *[f"- {line}" for line in left]] if left else [])]


def _plain(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    main()
