"""DAQP in a workspace that is kept across ticks, also in coordinates that make the Hessian the identity."""

from __future__ import annotations

import daqp
import numpy as np

from impact_posture.tsid.qp.quadratic_program import QP, Solved

# Exit flags of DAQP for a solution (2: soft constraints are active) and for an infeasible program.  4 is an answer
# that violates bounds after a cycle.  -6 (dependent equations) does not mean infeasible, because DAQP also returns it
# for bounds that were active before.
SOLVED, _NONE = (1, 2), -1
# Flag of a program that could not be solved for another reason.
_FAILED = 0
# Largest violation of a bound, most iterations of a program, and squared sine of the least angle between a row and
# the active rows.  The cost of a quadruped, with the condition 4e10, brings rows so close to each other that the
# default of DAQP, 3.7e-11, takes them for dependent.
_SETTINGS = {"primal_tol": 1e-9, "iter_limit": 1000, "sing_tol": 1e-13}


class DaqpSolver:
    """DAQP (Arnström, Bemporad, Axehill 2022) in one workspace; each solution starts from the last active set.

    After a reset, equal programs give bitwise equal answers.
    """

    def __init__(self, n: int, m: int, *, proximal: float | None = None) -> None:
        """Allocate a workspace for ``n`` variables and ``m`` rows.

        ``proximal`` is the weight of proximal-point iterations.  They take more time and solve programs whose cost
        is too flat for one factorization.  With ``None``, DAQP decides.
        """
        self._flag = 1
        self._model = daqp.Model()
        self._model.settings = _SETTINGS if proximal is None else _SETTINGS | {"eps_prox": proximal}
        # The first program only sets the dimensions.  Its bounds cannot be active.
        blank, upper = QP.empty(n, m), np.full(n + m, 1e30)
        self._model.setup(blank.H, blank.g, blank.A, upper, -upper, blank.sense)
        self._cold = True

    def reset(self) -> None:
        """Start the next program without an active set, and read its types of bounds again."""
        self._cold = True

    def solve(self, qp: QP) -> Solved | None:
        """Return the solution, or ``None`` if the program is infeasible or the solver failed (:attr:`infeasible`)."""
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
        """Whether the last program had no solution; false where the solver failed."""
        return self._flag == _NONE


class WhitenedSolver(DaqpSolver):
    """DAQP with a change of variables ``y = Rz``, ``H = RᵀR`` by LAPACK.

    DAQP computes this form by plain loops, which take most of its time for a humanoid.  LAPACK and one matrix product
    take half as long.  Bounds on the dense variables become rows.  The rest of ``H`` must be diagonal.
    """

    def __init__(self, n: int, m: int, dense: int) -> None:
        """Allocate for ``n`` variables and ``m`` rows; the first ``dense`` variables have a dense Hessian."""
        # Imported here, because SciPy takes long to import and only humanoids need it.
        from scipy.linalg.lapack import dpotrf, dtrtri

        super().__init__(n, dense + m)
        self._factorize, self._invert = dpotrf, dtrtri
        self._n, self._dense = n, dense
        self._qp = QP.empty(n, dense + m)
        # Views of R⁻¹ and, below it, of A R⁻¹ in the whitened rows.
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
