"""Any solver of the qpsolvers package on our programs, for cross-checks; qpsolvers is no dependency."""

from __future__ import annotations

import numpy as np

from impact_posture.errors import InputError
from impact_posture.tsid.qp import EQUALITY, QP, Solved


class QpsolversSolver:
    """A solver by its name in qpsolvers, cold at every program."""

    def __init__(self, name: str, **settings: float) -> None:
        """Take a solver.

        Args:
            name: As qpsolvers calls it: ``proxqp``, ``quadprog``, ….
            settings: Handed to it at every call.

        Raises:
            InputError: It is not installed.
        """
        try:
            import qpsolvers
        except ImportError:
            raise InputError("is not installed", where="qpsolvers", hint="pip install qpsolvers") from None
        if name not in qpsolvers.available_solvers:
            known = ", ".join(qpsolvers.available_solvers) or "none"
            raise InputError(f"solver '{name}' is not installed", where="qpsolvers", hint=f"there are: {known}")
        self._solve, self._problem, self._name, self._settings = (
            qpsolvers.solve_problem,
            qpsolvers.Problem,
            name,
            settings,
        )
        self._failed = False

    def reset(self) -> None:
        """Nothing is kept from one program to the next."""

    def solve(self, qp: QP) -> Solved | None:
        """The solution, or ``None``."""
        equal = qp.sense == EQUALITY
        rows = np.vstack([np.eye(qp.n), qp.A])
        above, below = ~equal & np.isfinite(qp.upper), ~equal & np.isfinite(qp.lower)
        problem = self._problem(
            qp.H,
            qp.g,
            np.vstack([rows[above], -rows[below]]),
            np.concatenate([qp.upper[above], -qp.lower[below]]),
            rows[equal] if equal.any() else None,
            qp.upper[equal] if equal.any() else None,
        )
        try:
            answer = self._solve(problem, solver=self._name, **self._settings)
        except ValueError:
            # quadprog's word for a program without a solution.
            answer = None
        self._failed = answer is None or not answer.found or answer.x is None
        if self._failed:
            return None
        multipliers = np.zeros(qp.n + qp.m)
        z = np.where(above, 1.0, 0.0)
        count = int(z.sum())
        multipliers[above] += answer.z[:count]
        multipliers[below] -= answer.z[count:]
        multipliers[equal] = answer.y
        return Solved(np.asarray(answer.x), multipliers, 0)

    @property
    def infeasible(self) -> bool:
        """Whether the last program had no solution, as far as the solver tells."""
        return self._failed
