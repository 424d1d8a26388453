"""Recompute the committed reference results and the page that shows them.

Run this script with: make regression
"""

from __future__ import annotations

import json

from tests.regression.cases import CASES, EXPECTED, PAGE, Case


def main() -> None:
    """Write ``expected.json`` and ``docs/generated/regression.md``."""
    found = {case.name: _result(case) for case in CASES}
    EXPECTED.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    PAGE.write_text(_page(found))
    print(_page(found))


def _result(case: Case) -> dict[str, object]:
    prepared, solution = case.solve()
    objective, certificate = prepared.problem.objective, solution.certificate
    before, after = (objective.oracle.quantities(q) for q in (solution.initial, solution.q))
    return {
        "command": case.command,
        "model_sha256": prepared.impact.robot.model_sha256,
        "reduction": solution.reduction,
        "redundancy": solution.redundancy,
        "supports": [s.frame for s in prepared.impact.supports],
        "before": {"H": before.H, "G": before.G, "V": before.V, "S": before.S},
        "after": {"H": after.H, "G": after.G, "V": after.V, "S": after.S},
        "certificate": certificate.to_dict(),
        "certified_starts": solution.certified_starts,
        "q": [float(v) for v in solution.q],
    }


def _page(found: dict[str, dict]) -> str:
    lines = [
        "<!-- Written by `make regression`; do not edit. -->",
        "",
        "| case | redundancy | reduction of H | H | 1/G in kg | V | S | stationarity | pose error |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, result in found.items():
        before, after, certificate = result["before"], result["after"], result["certificate"]
        error = max(certificate["pose_error_m"], certificate["pose_error_rad"])
        lines.append(
            f"| {name} | {result['redundancy']} | {result['reduction']:.1%} | {_both(before['H'], after['H'])} "
            f"| {_both(1 / before['G'], 1 / after['G'])} | {_both(before['V'], after['V'])} "
            f"| {_both(before['S'], after['S'])} | {_order(certificate['stationarity'])} | {_order(error)} |"
        )
    lines += ["", "Each row is one command:", "", "```text"]
    lines += [str(result["command"]) for result in found.values()]
    return "\n".join([*lines, "```", ""])


def _both(before: float, after: float) -> str:
    return f"{before:.3g} → {after:.3g}"


def _order(value: float) -> str:
    # The exact rounding error differs between machines, so the page shows only its order of magnitude.
    return "< 1e-8" if value < 1e-8 else f"{value:.0e}"


if __name__ == "__main__":
    main()
