"""Use a solver of the qpsolvers package instead of DAQP for the QPs of the online controllers."""

from __future__ import annotations

import numpy as np
import qpsolvers

from impact_posture.tsid.qp.quadratic_program import EQUALITY, QP, Solved


class QpsolversSolver:
    """Solver of qpsolvers (``proxqp``, ``quadprog``, …).  The solver does not use warm starts."""

    def __init__(self, name: str, **settings: float) -> None:
        self._name, self._settings = name, settings

    def solve(self, qp: QP) -> Solved | None:
        """Return the solution, or ``None`` if the program has no solution.

        Raises:
            qpsolvers.SolverNotFound: The named solver is not installed.
        """
        equal = qp.sense == EQUALITY
        rows = np.vstack([np.eye(qp.n), qp.A])
        above, below = ~equal & np.isfinite(qp.upper), ~equal & np.isfinite(qp.lower)
        problem = qpsolvers.Problem(
            qp.H,
            qp.g,
            np.vstack([rows[above], -rows[below]]),
            np.concatenate([qp.upper[above], -qp.lower[below]]),
            rows[equal] if equal.any() else None,
            qp.upper[equal] if equal.any() else None,
        )
        try:
            answer = qpsolvers.solve_problem(problem, solver=self._name, **self._settings)
        except ValueError:
            # quadprog raises this exception if a program has no solution.
            return None
        if not answer.found or answer.x is None:
            return None
        multipliers = np.zeros(qp.n + qp.m)
        count = int(above.sum())
        multipliers[above] += answer.z[:count]
        multipliers[below] -= answer.z[count:]
        multipliers[equal] = answer.y
        return Solved(np.asarray(answer.x), multipliers, 0)
