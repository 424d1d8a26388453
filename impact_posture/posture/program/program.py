"""The expressions of the nonlinear program.

In the lifted formulation, the linear equations of the impact are constraints of the program::

    min over x, a, f, s   aᵀWa        (or λ/2 for ``energy``)
    subject to            M(q)a − J_sᵀf − Jᵀs = 0,  J_s a + εf = 0,  equations of s and n,
                          c(q) within bounds,  |quaternions| = 1,  limits,

In this formulation, every function is linear or quadratic in a, f and s, and the exact Hessian stays small
(``docs/studies/formulations.py`` compares it with the form that eliminates a, f and s).  A worst case adds unknowns
and rows (:mod:`impact_posture.impact.worst_case.model_set`).
"""

from __future__ import annotations

from copy import copy
from functools import cached_property

import casadi as ca
import numpy as np

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from impact_posture.posture.program.program_rows import Derivatives, ProgramRows, joined
from impact_posture.system.arrays import Array


class Program:
    """Expressions of the nonlinear program; most of them are reused when rows are added to the problem.

    ``rows`` are the rows of the constraints, which all programs of a problem share.

    Attributes:
        numeric: The Pinocchio model, which all runs share.
        bounded: Number of inequalities ``≤ 0`` of the objective; these are the last rows of ``g``.
    """

    def __init__(self, problem: ConstrainedProblem, rows: ProgramRows | None = None) -> None:
        self.rows = rows = rows or ProgramRows(problem)
        self.chart, self.numeric = rows.chart, Numeric(problem.robot.model)
        impact = ca.SX.sym("own", len(problem.objective.parameters))
        scale, weight, self._price = ca.SX.sym("scale"), ca.SX.sym("weight"), ca.SX.sym("price")
        self.lifted = lifted = problem.objective.lift(rows.tree, impact, scale)
        self.bounded = int(lifted.inequalities.numel())
        self.value = lifted.value / scale + weight * rows.away
        self.parameters = ca.vertcat(impact, scale, weight, self._price, rows.reference, *rows.parameters)

    def branch(self) -> Program:
        """Return a copy to which rows can be added without changing this program."""
        branch = copy(self)
        branch.rows = self.rows.branch()
        return branch

    def symbols(self, problem: ConstrainedProblem) -> tuple[dict[str, ca.SX], dict[str, ca.Function]]:
        """Return the expressions of a problem and options of ``nlpsol``.

        The expressions are ``x`` (unknowns), ``p`` (parameters), ``f`` and ``g``.  If rows can be added to the
        problem, the options supply derivatives; otherwise, there are no options.
        """
        rows, objective = self.rows.lift(problem), self.lifted
        x = ca.vertcat(self.rows.x, objective.variables, rows.variables)
        g = ca.vertcat(self.rows.norms, rows.rows, objective.residual, objective.inequalities)
        symbols = {"x": x, "p": self.parameters, "f": self.value + self._price * rows.slack, "g": g}
        if not problem.grows:
            return symbols, {}
        joint = joined(self.fixed, self.rows.derivatives(rows), self.chart.nx)
        # The rows of ``joint`` are, in this order, the objective value, the quaternion norms, the rows of the
        # objective, and the rows of the constraints. In ``g``, the rows of the constraints come directly after the
        # quaternion norms.
        norms, count, fixed = self.rows.norms.numel(), rows.rows.numel(), self.fixed.multipliers.numel()
        order = [*range(1, 1 + norms), *range(fixed, fixed + count), *range(1 + norms, fixed)]
        return symbols, joint.reordered(order).options(x, self.parameters, joint.multipliers[0], g)

    @cached_property
    def fixed(self) -> Derivatives:
        """Derivatives of objective, quaternion norms and objective rows, which stay when constraints grow."""
        objective, nx, norms = self.lifted, self.chart.nx, self.rows.norms
        rows = ca.vertcat(self.value, norms, objective.rest, objective.inequalities)
        derivatives = Derivatives.of(rows, ca.vertcat(self.rows.x, objective.variables))
        for jump, row, column in objective.jumps:
            first = 1 + norms.numel() + row
            jacobian, hessian = jump.known_derivatives(derivatives.multipliers[first:])
            columns, size = [*range(nx), *range(nx + column, column + jacobian.shape[1])], jacobian.shape[0]
            derivatives.jacobian[first : first + size, columns] += jacobian
            derivatives.hessian[columns, columns] += hessian
        return derivatives


def parameters(problem: ConstrainedProblem, chart: Chart, scale: float, price: float) -> Array:
    """Return the values of the parameters of the program."""
    return np.concatenate(
        [
            problem.objective.parameters,
            [scale, problem.requirements.regularization, price],
            chart.to_x(problem.given),
            *[c.parameters for c in problem.constraints],
        ]
    )
