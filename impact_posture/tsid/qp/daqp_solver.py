"""DAQP solver with a workspace that all ticks share, and a variant that first makes the Hessian the identity."""

from __future__ import annotations

import daqp
import numpy as np

from impact_posture.tsid.qp.quadratic_program import QP, Solved

# Exit flags of DAQP.  ``SOLVED`` contains 1 and 2 (2: soft constraints are active).  ``_NONE`` means infeasible.
# After flag 4 (a cycle), the answer violates bounds.  Flag -6 (dependent equations) does not prove infeasibility,
# because DAQP also returns -6 if bounds of the last active set depend on each other.
SOLVED, _NONE = (1, 2), -1
# Exit flag of this class for a failure of the solver, which says nothing about feasibility.
_FAILED = 0
# Settings of DAQP.  ``primal_tol`` is the largest violation of a bound.  ``iter_limit`` is the largest number of
# iterations.  ``sing_tol`` is the squared sine of the smallest angle between a row and the active rows.  For a
# quadruped, the cost has the condition number 4e10 and makes rows nearly parallel.  With its default ``sing_tol`` of
# 3.7e-11, DAQP would treat such rows as dependent.
SETTINGS = {"primal_tol": 1e-9, "iter_limit": 1000, "sing_tol": 1e-13}


class DaqpSolver:
    """DAQP (Arnström, Bemporad, Axehill 2022) with one workspace.  Each call starts from the last active set.

    After a reset, equal quadratic programs give solutions that are equal in every bit.
    """

    def __init__(self, n: int, m: int, *, proximal: float | None = None) -> None:
        """Allocate a workspace for ``n`` variables and ``m`` rows.

        ``proximal`` is the weight of proximal-point iterations.  Proximal-point iterations take more time, but also
        solve a program whose Hessian is nearly singular.  With ``None``, DAQP decides whether to use proximal-point
        iterations.
        """
        self._flag = 1
        self._model = daqp.Model()
        self._model.settings = SETTINGS if proximal is None else SETTINGS | {"eps_prox": proximal}
        # The first program only sets the dimensions, and its bounds are so wide that they are never active.
        blank, upper = QP.empty(n, m), np.full(n + m, 1e30)
        self._model.setup(blank.H, blank.g, blank.A, upper, -upper, blank.sense)
        self._cold = True

    def reset(self) -> None:
        """Start the next program without an active set, and read again which of its rows are equations."""
        self._cold = True

    def solve(self, qp: QP) -> Solved | None:
        """Return the solution, or ``None`` if the program is :attr:`infeasible` or the solver failed."""
        sense = qp.sense if self._cold else None
        self._flag = self._model.update(qp.H, qp.g, qp.A, qp.upper, qp.lower, sense)
        if self._flag >= 0:
            z, _, self._flag, info = self._model.solve()
        # The active set of a failed attempt cannot be used for the next start.
        self._cold = self._flag not in SOLVED
        if self._cold:
            return None
        return Solved(z, info["lam"], int(info["iterations"]))

    @property
    def infeasible(self) -> bool:
        """Whether the last program had no solution; false if it has a solution or if the solver failed."""
        return self._flag == _NONE


class WhitenedSolver(DaqpSolver):
    """DAQP with the change of variables ``y = Rz``, where LAPACK factorizes ``H = RᵀR``.

    DAQP alone factorizes ``H`` by plain loops, which take most of the solution time for a humanoid.  LAPACK and one
    matrix product take half as long.  Bounds on the dense variables become rows.  The rest of ``H`` must be diagonal.
    """

    def __init__(self, n: int, m: int, dense: int) -> None:
        """Allocate buffers for ``n`` variables and ``m`` rows; the first ``dense`` variables have a dense Hessian."""
        # Imported here, because the import of SciPy is slow and only humanoids need SciPy.
        from scipy.linalg.lapack import dpotrf, dtrtri

        super().__init__(n, dense + m)
        self._factorize, self._invert = dpotrf, dtrtri
        self._n, self._dense = n, dense
        self._qp = QP.empty(n, dense + m)
        # Views on the rows of the transformed program: first R⁻¹, below it A R⁻¹.
        self._bounds, self._rows = self._qp.A[:dense, :dense], self._qp.A[dense:, :dense]
        self._others = self._qp.A[dense:, dense:]

    def solve(self, qp: QP) -> Solved | None:
        n, d, white = self._n, self._dense, self._qp
        R, failed = self._factorize(qp.H[:d, :d])
        if failed:
            self._flag = _FAILED
            return None
        inverse, _ = self._invert(R, overwrite_c=1)
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
