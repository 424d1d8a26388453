"""Linear programs by HiGHS of the CasADi wheels; SciPy takes longer to import than many problems take to solve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from impact_posture.system.arrays import Array

# The default tolerances of HiGHS, 1e-7, are coarser than what a certificate accepts.
_OPTIONS: dict[str, Any] = {
    "error_on_fail": False,
    "highs": {"output_flag": False, "primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
}


@dataclass(frozen=True, eq=False)
class LinearOptimum:
    """Solution of ``min cᵀx`` with ``lower ≤ A x ≤ upper`` and ``low ≤ x ≤ high``.

    Attributes:
        x: Unknowns, shape (n,).
        value: ``cᵀx``.
        multipliers: Multiplier of each row of ``A``, positive at its upper bound, shape (m,).
    """

    x: Array
    value: float
    multipliers: Array


def solve_linear(
    cost: Array, rows: Array, lower: Array, upper: Array, low: Array, high: Array
) -> LinearOptimum | None:
    """Return the optimum; ``None`` if there is none."""
    solver = _solver(*rows.shape)
    found = solver(g=cost, a=rows, lba=lower, uba=upper, lbx=low, ubx=high)
    if not solver.stats()["success"]:
        return None
    x, multipliers = (np.array(found[key]).reshape(-1) for key in ("x", "lam_a"))
    return LinearOptimum(x, float(cost @ x), multipliers)


@cache
def _solver(rows: int, unknowns: int) -> ca.Function:
    sparsity = {"a": ca.Sparsity.dense(rows, unknowns), "h": ca.Sparsity(unknowns, unknowns)}
    return ca.conic("linear_program", "highs", sparsity, _OPTIONS)
