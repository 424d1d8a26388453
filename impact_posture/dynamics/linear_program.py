"""Linear programs, solved by HiGHS from the CasADi wheels, because importing scipy.optimize takes 0.35 s."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from impact_posture.system.arrays import Array

# The default tolerances of HiGHS, 1e-7, are too large for a certificate.
_OPTIONS: dict[str, Any] = {
    "error_on_fail": False,
    "highs": {"output_flag": False, "primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
}
_PRIMAL: dict[str, Any] = {"presolve": "off", "simplex_strategy": 4}


@dataclass(frozen=True, eq=False)
class LinearOptimum:
    """Solution ``x`` of ``min cᵀx`` with ``lower ≤ A x ≤ upper`` and ``low ≤ x ≤ high``, and its value ``cᵀx``.

    ``multipliers`` are the multipliers of the rows of ``A``, shape (m,); they are positive at upper bounds.
    """

    x: Array
    value: float
    multipliers: Array


def solve_linear(
    cost: Array, rows: Array, lower: Array, upper: Array, low: Array, high: Array, *, primal: bool = False
) -> LinearOptimum | None:
    """Return the optimum of :class:`LinearOptimum`, or ``None`` if the solver reports no success.

    ``primal`` selects the primal simplex method without presolve, which takes half the time on small programs.  If
    several ``x`` are optimal, the methods may return different ones.
    """
    solver = _solver(*rows.shape, primal)
    solution = solver(g=cost, a=rows, lba=lower, uba=upper, lbx=low, ubx=high)
    if not solver.stats()["success"]:
        return solve_linear(cost, rows, lower, upper, low, high) if primal else None
    x, multipliers = (np.array(solution[key]).reshape(-1) for key in ("x", "lam_a"))
    return LinearOptimum(x, float(cost @ x), multipliers)


@cache
def _solver(rows: int, unknowns: int, primal: bool) -> ca.Function:
    sparsity = {"a": ca.Sparsity.dense(rows, unknowns), "h": ca.Sparsity(unknowns, unknowns)}
    options = _OPTIONS | {"highs": _OPTIONS["highs"] | _PRIMAL} if primal else _OPTIONS
    return ca.conic("linear_program", "highs", sparsity, options)
