"""Solver of QPs with a large dense cost, in coordinates that make the Hessian the identity."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from impact_posture.tsid.daqp_solver import FAILED, DaqpSolver
from impact_posture.tsid.qp import QP, Solved


class WhitenedSolver(DaqpSolver):
    """DAQP behind a change of variables ``y = Rz``, ``H = RᵀR``, made by LAPACK.

    DAQP brings every program to this form by plain loops, which take most of its time for a humanoid.  LAPACK and one
    matrix product take half as long.  Bounds on the dense variables become rows.  The rest of ``H`` must be diagonal.
    """

    def __init__(self, n: int, m: int, dense: int) -> None:
        """Allocate for ``n`` variables and ``m`` rows; the first ``dense`` variables have a dense Hessian."""
        super().__init__(n, dense + m)
        self._n, self._dense = n, dense
        self._qp = QP.empty(n, dense + m)
        # Places of R⁻¹ and, below it, of A R⁻¹ in the whitened rows.
        self._bounds, self._rows = self._qp.A[:dense, :dense], self._qp.A[dense:, :dense]
        self._others = self._qp.A[dense:, dense:]

    def solve(self, qp: QP) -> Solved | None:
        """Return the solution, or ``None``."""
        n, d, white = self._n, self._dense, self._qp
        R, failed = dpotrf(qp.H[:d, :d])
        if failed:
            self._flag = FAILED
            return None
        inverse, _ = dtrtri(R, overwrite_c=1)
        self._bounds[:] = inverse
        np.matmul(qp.A[:, :d], inverse, out=self._rows)
        self._others[:] = qp.A[:, d:]
        np.matmul(qp.g[:d], inverse, out=white.g[:d])
        white.g[d:] = qp.g[d:]
        white.H.reshape(-1)[d * (n + 1) :: n + 1] = qp.H.reshape(-1)[d * (n + 1) :: n + 1]
        for ours, theirs in ((white.lower, qp.lower), (white.upper, qp.upper)):
            ours[d:n], ours[n : n + d], ours[n + d :] = theirs[d:n], theirs[:d], theirs[n:]
        white.sense[d:n], white.sense[n : n + d], white.sense[n + d :] = qp.sense[d:n], qp.sense[:d], qp.sense[n:]
        solved = super().solve(white)
        if solved is None:
            return None
        z, multipliers = solved.z, solved.multipliers
        z[:d] = inverse @ z[:d]
        multipliers = np.concatenate([multipliers[n : n + d], multipliers[d:n], multipliers[n + d :]])
        return Solved(z, multipliers, solved.iterations)
