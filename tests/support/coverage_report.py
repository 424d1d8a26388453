"""Measure the branch coverage of both packages by the whole test suite, and write the coverage page.

Run this module as ``python -m tests.support.coverage_report`` (``make coverage``).  The measurement takes twice as
long as the suite.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "generated" / "coverage.md"
LEAST = 90.0
# Files whose coverage may be below `LEAST`, with the reason.
REASONS = {
    "cli/commands/reproduce.py": "tests request JSON, not the printed tables",
    "impact_posture/posture/program/posture_nlp.py": "the reaction to Ctrl-C while IPOPT runs in the main process",
    "impact_posture/posture/search/multistart.py": "second attempts and failures that no test problem has",
}


def measured(arguments: list[str]) -> dict[str, dict[str, int]]:
    """Run the suite.  Return for each file how many statements and branches exist, and how many were executed."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "COVERAGE_FILE": str(Path(folder) / "data")}

        def coverage(*words: str) -> int:
            return subprocess.run([sys.executable, "-m", "coverage", *words], cwd=ROOT, env=environment).returncode

        status = coverage("run", "-m", "pytest", "-q", *arguments)
        if status:
            sys.exit(status)
        coverage("combine", "--quiet")
        report = Path(folder) / "coverage.json"
        coverage("json", "--quiet", "-o", str(report))
        return {name: file["summary"] for name, file in json.loads(report.read_text())["files"].items()}


def share(files: list[dict[str, int]]) -> float:
    """Return the percentage of statements and branches that were executed."""
    reached = sum(f["covered_lines"] + f["covered_branches"] for f in files)
    every = sum(f["num_statements"] + f["num_branches"] for f in files)
    return 100.0 * reached / every if every else 100.0


def markdown(files: dict[str, dict[str, int]]) -> str:
    """Write a table by folder, and list the files below :data:`LEAST` with the reason."""
    folders = defaultdict(list)
    for name, summary in files.items():
        folders[str(Path(name).parent)].append(summary)
    lines = ["| folder | statements | branches | reached |", "|---|---|---|---|"]
    for name in sorted(folders):
        some = folders[name]
        counts = (sum(f[key] for f in some) for key in ("num_statements", "num_branches"))
        lines.append(f"| `{name}` | {' | '.join(map(str, counts))} | {share(some):.1f} % |")
    lines += [f"| together | | | {share([*files.values()]):.1f} % |", ""]
    low = {name: share([summary]) for name, summary in files.items() if share([summary]) < LEAST}
    if low:
        lines += [f"Below {LEAST:.0f} %:", "", "| file | reached | why |", "|---|---|---|"]
        lines += [f"| `{name}` | {low[name]:.1f} % | {REASONS.get(name, '–')} |" for name in sorted(low)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(markdown(measured(sys.argv[1:])), encoding="utf-8")
    print(PAGE.read_text(encoding="utf-8"))
