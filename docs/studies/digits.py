"""Effect of the compliance of feet, and accuracy of double precision compared with 60-digit arithmetic."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import numpy as np

from docs.studies.cases import CASES, Case
from docs.studies.core import Request, table
from impact_posture.codegen.export import export
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from tests.support.exact import Exact, ExactImpact, digits, distance
from tests.support.exact_bounds import Bounded
from tests.support.exported import built
from tests.support.helpers import random_configurations

_CASES = ("solo8, four feet", "solo8, aside", "solo12", "bolt", "talos, two feet")
COMPLIANCES = (1e-4, 1e-6, 1e-9)
# Compliance that represents rigid feet.  The bias of this compliance is below rounding.  A smaller compliance would
# amplify the rounding of J_s.
_RIGID = 1e-14
_HEAD = "robot|n|rank of $J_s$|ε m|bound|$H$ moved|oracle: H|∇H|f|kernel: H|∇H|C: H|∇H".split("|")


def lines(request: Request) -> Iterator[str]:
    yield (
        f"Smallest number of correct digits over the default posture and {request.count} random postures. In\n"
        "brackets: digits that backward error analysis guarantees. $H$ moved: largest relative change of $H$ by\n"
        "the compliance, compared with rigid feet. Bound: $\\varepsilon/(\\sigma+\\varepsilon)$, relative to the\n"
        "effect of the feet on the jump."
    )
    yield ""
    wanted = [CASES[name] for name in _CASES if request.only in name]
    with digits():
        yield from table(_HEAD, (_row(case, share, request.count) for case in wanted for share in COMPLIANCES))


def _row(case: Case, share: float, postures: int) -> list[str]:
    robot, normal = load_robot(case.robot), case.normal or (0.0, 0.0, 1.0)
    supports = robot.spec.supports
    contact = ImpactContact(robot.spec.contact.frame or "", normal)
    objective = WorstCaseObjective(robot, contact, supports=supports, compliance=share / robot.mass)
    k, oracle = objective.kernel, objective.oracle
    kernel = ca.Function("kernel", [k.q, k.n], [k.H, k.grad_H], {"cse": True})
    kept: dict[str, list[tuple[float, float]]] = {}
    moved, bound, ranks = 0.0, 0.0, set()
    with tempfile.TemporaryDirectory() as folder:
        export(objective, Path(folder), prefix="feet", check=False)
        with built(Path(folder), "feet") as library:
            for q in [
                robot.posture(),
                *random_configurations(robot.model, postures, robot.name, "digits", spread=0.5),
            ]:
                own, gradient = oracle.quantities(q), oracle.gradient_H(q)
                x = Bounded(oracle.at(q), objective.compliance)
                rigid = ExactImpact(oracle, _RIGID / robot.mass)
                bound = max(bound, x.share)
                moved = max(moved, abs(float(x.H / rigid.H) - 1))
                ranks.add(int(np.linalg.matrix_rank(oracle.Js, tol=1e-9)))
                H, dH = (np.array(v).ravel() for v in kernel(q, oracle.n))
                _, C_H, C_dH = library.eval(q, np.array(oracle.n))
                for key, value, expected, promised in (
                    ("oracle H", own.H, np.array([x.H]), x.H_by_elimination),
                    ("oracle ∇H", gradient, x.grad_H, x.gradient_by_elimination),
                    ("oracle f", own.support_impulse, x.impulse, x.lost_by_elimination[x.nv :]),
                    ("kernel H", float(H[0]), np.array([x.H]), x.H_by_heavy_feet),
                    ("kernel ∇H", dH, x.grad_H, x.gradient_by_heavy_feet),
                    ("C H", C_H, np.array([x.H]), x.H_by_heavy_feet),
                    ("C ∇H", C_dH, x.grad_H, x.gradient_by_heavy_feet),
                ):
                    kept.setdefault(key, []).append(_digits(value, expected, promised, 1e-3 * float(x.H)))
    rank = "–".join(str(r) for r in sorted({min(ranks), max(ranks)}))
    cells = [robot.name, " ".join(f"{v:g}" for v in normal), rank, f"{share:.0e}", f"{bound:.1e}", f"{moved:.1e}"]
    return cells + [f"{min(own for own, _ in pairs):.0f} ({min(b for _, b in pairs):.0f})" for pairs in kept.values()]


def _digits(value: object, expected: Exact, promised: object, least: float) -> tuple[float, float]:
    """Return the number of correct digits and of guaranteed digits, relative to the largest entry or ``least``."""
    scale = max(float(np.max(np.abs(np.asarray(expected, dtype=float)))), least)
    worst = float(np.max(distance(value, expected))) / scale
    return -np.log10(max(worst, 1e-16)), -np.log10(float(np.max(np.asarray(promised))) / scale)
