"""What a compliance of the feet changes, and how many digits double precision keeps: against sixty digits.

Run: python -m tests.benchmarks.support_digits [--write]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from impact_posture.codegen.export import export
from impact_posture.impact.contact import ImpactContact, Support
from impact_posture.impact.objective import ImpactObjective
from impact_posture.robot.robot_loader import load_robot
from tests.exact import Exact, ExactImpact, digits, distance
from tests.exact_bounds import Bounded
from tests.exported import built
from tests.helpers import random_configurations

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "digits.md"
CASES = [
    ("solo8", (1.0, 0.0, 0.0)),
    ("solo8", (0.0, 1.0, 0.0)),
    ("solo12", (1.0, 0.0, 0.0)),
    ("bolt", (1.0, 0.0, 0.0)),
    ("talos", (1.0, 0.0, 0.0)),
]
COMPLIANCES = (1e-4, 1e-6, 1e-9)
POSTURES = 3
# Its bias is beyond doubles, and the rounding of J_s holds nothing at it.
_RIGID = 1e-14


def main() -> None:
    """Print the table; with ``--write`` renew the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name} of the documentation")
    asked = parser.parse_args()
    with digits():
        page = "\n".join(_lines())
    print(page)
    if asked.write:
        head = "<!-- Written by `python -m tests.benchmarks.support_digits --write`; do not edit. -->"
        PAGE.write_text(f"{head}\n\n{page}\n", encoding="utf-8")


def _lines() -> list[str]:
    found = [
        f"The least digits over the default and {POSTURES} random postures; in brackets what backward error analysis",
        "promises. $H$ moved: by the compliance, at most, against feet held exactly; before it the bound",
        "$\\varepsilon/(\\sigma+\\varepsilon)$ on the share of what the feet do.",
        "",
        "| robot | n | rank of $J_s$ | ε m | bound | $H$ moved | oracle: H | ∇H | f | kernel: H | ∇H | C: H | ∇H |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, normal in CASES:
        for share in COMPLIANCES:
            found.append(_row(name, normal, share))
    return found


def _row(name: str, normal: tuple[float, float, float], share: float) -> str:
    robot = load_robot(name)
    supports = tuple(Support.from_spec(s) for s in robot.spec.supports)
    contact = ImpactContact(robot.spec.contact.frame or "", normal)
    objective = ImpactObjective(robot, contact, supports=supports, compliance=share / robot.mass)
    kernel = objective.metric_fun()
    kept: dict[str, list[tuple[float, float]]] = {}
    moved, bound, ranks = 0.0, 0.0, set()
    with tempfile.TemporaryDirectory() as folder:
        export(objective, Path(folder), prefix="feet", check=False)
        with built(Path(folder), "feet") as library:
            for q in [robot.posture(), *random_configurations(robot.model, POSTURES, name, "digits", spread=0.5)]:
                oracle = objective.oracle
                own, gradient = oracle.quantities(q), oracle.gradient_H(q)
                x = Bounded(oracle.at(q), objective.compliance)
                rigid = ExactImpact(oracle, _RIGID / robot.mass)
                bound = max(bound, x.share)
                moved = max(moved, abs(float(x.H / rigid.H) - 1))
                ranks.add(int(np.linalg.matrix_rank(oracle.Js, tol=1e-9)))
                H, dH = (np.array(v).ravel() for v in kernel(q, oracle.n))
                _, C_H, C_dH = library.eval(q, np.array(oracle.n))
                least = 1e-3 * float(x.H)
                for key, value, expected, promised in (
                    ("oracle H", own.H, np.array([x.H]), x.H_by_elimination),
                    ("oracle ∇H", gradient, x.grad_H, x.gradient_by_elimination),
                    ("oracle f", own.support_impulse, x.impulse, x.lost_by_elimination[x.nv :]),
                    ("kernel H", float(H[0]), np.array([x.H]), x.H_by_heavy_feet),
                    ("kernel ∇H", dH, x.grad_H, x.gradient_by_heavy_feet),
                    ("C H", C_H, np.array([x.H]), x.H_by_heavy_feet),
                    ("C ∇H", C_dH, x.grad_H, x.gradient_by_heavy_feet),
                ):
                    kept.setdefault(key, []).append(_digits(value, expected, promised, least))
    words = [f"{min(own for own, _ in pairs):.0f} ({min(b for _, b in pairs):.0f})" for pairs in kept.values()]
    n = " ".join(f"{v:g}" for v in normal)
    rank = "–".join(str(r) for r in sorted({min(ranks), max(ranks)}))
    return f"| {name} | {n} | {rank} | {share:.0e} | {bound:.1e} | {moved:.1e} | {' | '.join(words)} |"


def _digits(found: object, expected: Exact, promised: object, least: float) -> tuple[float, float]:
    """Digits kept, and digits promised, relative to the largest entry or to ``least`` if that is more."""
    scale = max(float(np.max(np.abs(np.asarray(expected, dtype=float)))), least)
    worst = float(np.max(distance(found, expected))) / scale
    return -np.log10(max(worst, 1e-16)), -np.log10(float(np.max(np.asarray(promised))) / scale)


if __name__ == "__main__":
    main()
