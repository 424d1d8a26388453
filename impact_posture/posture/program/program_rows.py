"""The rows of all constraints of a program that can grow; the parts of each constraint are differentiated once.

First and second derivatives take most of the time to build a program.  When rows are added, most parts stay the same,
so their derivatives are reused.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import LiftedRows
from impact_posture.posture.constraints.posture_distance import distance_squared
from impact_posture.posture.program.constrained_problem import ConstrainedProblem


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Jacobian of rows ``g(x, z)`` and Hessian of ``λᵀg``; ``multipliers`` are the symbols ``λ``, shape (m, 1).

    The Jacobian has the shape (m, nx + k), the Hessian (nx + k, nx + k).
    """

    multipliers: ca.SX
    jacobian: ca.SX
    hessian: ca.SX

    @staticmethod
    def of(rows: ca.SX, unknowns: ca.SX) -> Derivatives:
        """Differentiate ``rows`` with respect to ``unknowns``."""
        multipliers = ca.SX.sym("multipliers", rows.numel())
        hessian = ca.hessian(ca.dot(multipliers, rows), unknowns)[0]
        return Derivatives(multipliers, ca.jacobian(rows, unknowns), hessian)

    def reordered(self, rows: list[int]) -> Derivatives:
        """Return the derivatives of ``rows``, in this order; the Hessian still contains all multipliers."""
        return Derivatives(self.multipliers[rows], self.jacobian[rows, :], self.hessian)

    def options(self, x: ca.SX, p: ca.SX, price: ca.SX, g: ca.SX) -> dict[str, ca.Function]:
        """Return options of ``nlpsol`` that supply the derivatives of ``g``; ``price`` is the multiplier of f.

        In a compiled library, CasADi identifies the derivatives by the names of functions, inputs and outputs.
        """
        lagrangian, hessian = [x, p, price, self.multipliers], [ca.triu(self.hessian)]
        names = ["x", "p", "lam_f", "lam_g"]
        return {
            "jac_g": ca.Function("nlp_jac_g", [x, p], [g, self.jacobian], names[:2], ["g", "jac_g_x"]),
            "hess_lag": ca.Function("nlp_hess_l", lagrangian, hessian, names, ["triu_hess_gamma_x_x"]),
        }


class ProgramRows:
    """Rows of the constraints of a problem, including all added rows, which all programs of the problem share.

    Attributes:
        x: Chart coordinates, shape (nx, 1).
        norms: Squared norms of the quaternions minus one.
        reference: Symbols of the chart coordinates of the given posture, shape (nx, 1).
        away: Expression of the squared distance from the given posture.
        parameters: Symbols of the parameters of each constraint.
    """

    def __init__(self, problem: ConstrainedProblem) -> None:
        self.chart = chart = Chart.of(problem.robot.model)
        self.x, self.reference = ca.SX.sym("x", chart.nx), ca.SX.sym("reference", chart.nx)
        self.tree = Tree(problem.robot.model, chart.configuration(self.x), self.x)
        self.norms = chart.norms(self.x)
        self.away = distance_squared(chart, self.tree.q, chart.configuration(self.reference))
        self.parameters = [ca.SX.sym(f"p{k}", len(c.parameters)) for k, c in enumerate(problem.constraints)]
        self._lifted: dict[tuple[int, str, tuple[int, ...]], LiftedRows] = {}
        self._blocks: list[tuple[Derivatives, list[LiftedRows]]] = []
        self._sides = WeakKeyDictionary[LiftedRows, Derivatives]()

    def branch(self) -> ProgramRows:
        """Return a copy to which rows can be added without changing these rows."""
        branch = copy(self)
        branch._lifted, branch._blocks = dict(self._lifted), list(self._blocks)
        return branch

    def lift(self, problem: ConstrainedProblem) -> LiftedRows:
        """Return the rows that each constraint of a problem has in the program."""
        pieces = []
        for index, constraint in enumerate(problem.constraints):
            carried = problem.carried(index)
            # A constraint with another target has the same expressions, so they are reused.
            key = index, constraint.structure, tuple(carried)
            if key not in self._lifted:
                lifted = constraint.lift(self.tree, self.parameters[index])
                if not lifted.pieces:
                    lifted = LiftedRows(lifted.rows[carried], lifted.variables, lifted.slack)
                self._lifted[key] = lifted
            pieces.append(self._lifted[key])
        return LiftedRows.joined(pieces)

    def derivatives(self, lifted: LiftedRows) -> Derivatives:
        """Return the derivatives of the rows of :meth:`lift` with respect to ``(x, z)``."""
        nx, row, column = self.x.numel(), 0, 0
        rows, sides, columns = dict[int, range](), dict[int, range](), dict[int, range]()
        pieces: dict[int, LiftedRows] = {}
        for constraint in lifted.pieces:
            its_pieces = constraint.pieces or (constraint,)
            for kind, places in (("rows", rows), ("sides", sides)):
                for piece in its_pieces:
                    size = getattr(piece, kind).numel()
                    places[id(piece.rows)] = range(row, row + size)
                    row += size
            for piece in its_pieces:
                if piece.rows.numel():
                    pieces[id(piece.rows)] = piece
                columns[id(piece.rows)] = range(column, column + piece.variables.numel())
                column += piece.variables.numel()
        self._differentiate(list(pieces.values()))
        # The first part is empty, and gives the matrices the right shapes even if there are no rows.
        parts, order = [Derivatives(ca.SX(0, 1), ca.SX(0, nx), ca.SX(nx, nx))], list[int]()
        at = [k for _, block in self._blocks for piece in block for k in columns[id(piece.rows)]]
        for derivatives, block in self._blocks:
            present = [pieces[id(piece.rows)] for piece in block]
            parts.append(_with_sides(derivatives, [self._of_sides(piece) for piece in present], nx))
            order += [k for places in (rows, sides) for piece in present for k in places[id(piece.rows)]]
        J, H = _stacked(parts, nx)
        new_columns = [*range(nx), *(nx + np.argsort(at)).tolist()]
        multipliers = ca.vertcat(*[part.multipliers for part in parts])
        new_rows = np.argsort(order).tolist()
        return Derivatives(multipliers[new_rows], J[new_rows, new_columns], H[new_columns, new_columns])

    def _of_sides(self, piece: LiftedRows) -> Derivatives:
        if piece not in self._sides:
            self._sides[piece] = Derivatives.of(piece.sides, piece.variables)
        return self._sides[piece]

    def _differentiate(self, pieces: list[LiftedRows]) -> None:
        """Differentiate all new pieces together, because the pieces have common subexpressions."""
        known = {id(piece.rows) for _, block in self._blocks for piece in block}
        new = [piece for piece in pieces if id(piece.rows) not in known]
        if new:
            unknowns = ca.vertcat(self.x, *[piece.variables for piece in new])
            self._blocks.append((Derivatives.of(ca.vertcat(*[piece.rows for piece in new]), unknowns), new))


def _with_sides(rows: Derivatives, sides: list[Derivatives], nx: int) -> Derivatives:
    """Add the derivatives of :attr:`LiftedRows.sides`, which depend only on the auxiliary unknowns of one piece."""
    jacobian = ca.diagcat(*[part.jacobian for part in sides])
    return Derivatives(
        ca.vertcat(rows.multipliers, *[part.multipliers for part in sides]),
        ca.vertcat(rows.jacobian, ca.horzcat(ca.SX(jacobian.shape[0], nx), jacobian)),
        rows.hessian + ca.diagcat(ca.SX(nx, nx), *[part.hessian for part in sides]),
    )


def _stacked(parts: list[Derivatives], nx: int) -> tuple[ca.SX, ca.SX]:
    """Return the Jacobian and Hessian of all parts together; they share the unknowns x but no auxiliary unknowns."""
    J = ca.horzcat(ca.vertcat(*[p.jacobian[:, :nx] for p in parts]), ca.diagcat(*[p.jacobian[:, nx:] for p in parts]))
    both = ca.horzcat(*[p.hessian[:nx, nx:] for p in parts])
    H = ca.vertcat(
        ca.horzcat(sum((p.hessian[:nx, :nx] for p in parts), ca.SX(nx, nx)), both),
        ca.horzcat(both.T, ca.diagcat(*[p.hessian[nx:, nx:] for p in parts])),
    )
    return J, H


def joined(first: Derivatives, second: Derivatives, nx: int) -> Derivatives:
    """Join the derivatives of two sets of rows; the sets share the unknowns x but no auxiliary unknowns."""
    return Derivatives(ca.vertcat(first.multipliers, second.multipliers), *_stacked([first, second], nx))
