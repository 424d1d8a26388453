"""DAQP held as one model across ticks."""

from __future__ import annotations

import daqp
import numpy as np

from impact_posture.tsid.qp import QP, Solved

# Exit flags of DAQP: 1 and 2 are solutions (2: soft constraints are active); -1 says that there is none.  So would -6
# (equations depend on others), were it not also about bounds that were active before.
_NONE = -1


class DaqpSolver:
    """DAQP (Arnström, Bemporad, Axehill 2022) in one workspace; each solution starts from the last active set.

    Two solvers that were reset and given the same programs give the same answers to the bit.
    """

    def __init__(self, n: int, m: int, *, tolerance: float = 1e-9, iterations: int = 1000) -> None:
        """Allocate a workspace for ``n`` variables and ``m`` rows.

        Args:
            n: Variables.
            m: Rows.
            tolerance: Of a bound's violation.
            iterations: At most, for one program.
        """
        self._flag = 1
        self._model = daqp.Model()
        self._model.settings = {"primal_tol": tolerance, "iter_limit": iterations}
        # Dimensions only: this first program has no bound that could bind.
        blank, upper = QP.empty(n, m), np.full(n + m, 1e30)
        self._model.setup(blank.H, blank.g, blank.A, upper, -upper, blank.sense)
        self._cold = True

    def reset(self) -> None:
        """Begin the next program with no active set, and take its types of bounds anew."""
        self._cold = True

    def solve(self, qp: QP) -> Solved | None:
        """Solve; ``None`` without a solution."""
        sense = qp.sense if self._cold else None
        self._flag = self._model.update(qp.H, qp.g, qp.A, qp.upper, qp.lower, sense)
        if self._flag >= 0:
            z, _, self._flag, info = self._model.solve()
        # A failed attempt leaves no active set worth having.
        self._cold = self._flag <= 0
        if self._flag <= 0:
            return None
        return Solved(z, info["lam"], int(info["iterations"]))

    @property
    def infeasible(self) -> bool:
        """Whether the last program had no solution."""
        return self._flag == _NONE
