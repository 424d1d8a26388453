"""DAQP in one model that is kept across ticks."""

from __future__ import annotations

import daqp
import numpy as np

from impact_posture.tsid.qp import QP, Solved

# Exit flags of DAQP for a solution (2: soft constraints are active) and for a program without one.  4 is an answer
# that violates bounds after it went in circles.  -6 (dependent equations) does not count, because DAQP also returns
# it for bounds that were active before.
SOLVED, _NONE = (1, 2), -1
# Flag of a program that could not be solved for another reason.
FAILED = 0
# Largest violation of a bound, largest number of iterations for one program, and squared sine of the angle between a
# row and the active rows below which it depends on them.  The cost of a quadruped, with the condition 4e10, turns
# rows so close to each other that DAQP's default, 3.7e-11, takes them for dependent, and finds no answer.
_SETTINGS = {"primal_tol": 1e-9, "iter_limit": 1000, "sing_tol": 1e-13}


class DaqpSolver:
    """DAQP (Arnström, Bemporad, Axehill 2022) in one workspace; each solution starts from the last active set.

    After a reset, equal programs give bitwise equal answers.
    """

    def __init__(self, n: int, m: int, *, proximal: float | None = None) -> None:
        """Allocate a workspace for ``n`` variables and ``m`` rows.

        Args:
            n: Number of variables.
            m: Number of rows.
            proximal: Weight of proximal-point iterations, which solve programs whose cost is too flat for one
                factorization, in more time.  DAQP decides by itself without it.
        """
        self._flag = 1
        self._model = daqp.Model()
        self._model.settings = _SETTINGS if proximal is None else _SETTINGS | {"eps_prox": proximal}
        # The first program only sets the dimensions.  None of its bounds can be active.
        blank, upper = QP.empty(n, m), np.full(n + m, 1e30)
        self._model.setup(blank.H, blank.g, blank.A, upper, -upper, blank.sense)
        self._cold = True

    def reset(self) -> None:
        """Start the next program without an active set, and read its types of bounds again."""
        self._cold = True

    def solve(self, qp: QP) -> Solved | None:
        """Return the solution, or ``None`` if there is none."""
        sense = qp.sense if self._cold else None
        self._flag = self._model.update(qp.H, qp.g, qp.A, qp.upper, qp.lower, sense)
        if self._flag >= 0:
            z, _, self._flag, info = self._model.solve()
        # The active set of a failed attempt is useless.
        self._cold = self._flag not in SOLVED
        if self._cold:
            return None
        return Solved(z, info["lam"], int(info["iterations"]))

    @property
    def infeasible(self) -> bool:
        """Whether the last program had no solution."""
        return self._flag == _NONE
