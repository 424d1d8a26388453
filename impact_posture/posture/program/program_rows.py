"""The rows of all constraints in a program that grows, with derivatives that are computed once for each piece.

Most of the time to build a program goes into its first and second derivatives.  When a program grows, all but a few
of its pieces stay as they were, and so do their derivatives.
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
    """Derivatives of rows ``g(x, z)``.

    Attributes:
        multipliers: Symbols ``λ``, shape (m, 1).
        jacobian: ``∂g/∂(x, z)``, shape (m, nx + k).
        hessian: Second derivatives of ``λᵀg``, shape (nx + k, nx + k).
    """

    multipliers: ca.SX
    jacobian: ca.SX
    hessian: ca.SX

    @staticmethod
    def of(rows: ca.SX, unknowns: ca.SX) -> Derivatives:
        """Differentiate rows."""
        multipliers = ca.SX.sym("multipliers", rows.numel())
        return Derivatives(
            multipliers, ca.jacobian(rows, unknowns), ca.hessian(ca.dot(multipliers, rows), unknowns)[0]
        )

    def options(self, x: ca.SX, p: ca.SX, price: ca.SX, g: ca.SX) -> dict[str, ca.Function]:
        """Return the options of ``nlpsol`` for ``g`` with these derivatives; ``price`` is the multiplier of f.

        CasADi looks for them in a library by the names of functions, inputs and outputs.
        """
        jacobian, lagrangian = [x, p], [x, p, price, self.multipliers]
        hessian = [ca.triu(self.hessian)]
        return {
            "jac_g": ca.Function("nlp_jac_g", jacobian, [g, self.jacobian], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "nlp_hess_l", lagrangian, hessian, ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
            ),
        }


class ProgramRows:
    """Lifts the constraints of a problem, and those of all problems that it grows into, for all of its programs.

    Args:
        problem: The problem before it grows.

    Attributes:
        chart: Coordinates of the robot.
        x: Chart coordinates, shape (nx, 1).
        tree: The dynamics at ``x``.
        norms: Squared norms of the quaternions less one.
        reference: Chart coordinates of the given posture, shape (nx, 1).
        away: Squared distance from the given posture.
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
        """Return rows that grow on their own from here."""
        made = copy(self)
        made._lifted, made._blocks = dict(self._lifted), list(self._blocks)
        return made

    def lift(self, problem: ConstrainedProblem) -> LiftedRows:
        """Return the rows that the program of a problem carries, by constraint."""
        found = []
        for index, constraint in enumerate(problem.constraints):
            carried = problem.carried(index)
            # Constraints with another target have the same expressions.
            key = index, constraint.structure, tuple(carried)
            if key not in self._lifted:
                lifted = constraint.lift(self.tree, self.parameters[index])
                if not lifted.pieces:
                    lifted = LiftedRows(lifted.rows[carried], lifted.variables, lifted.slack)
                self._lifted[key] = lifted
            found.append(self._lifted[key])
        return LiftedRows.joined(found)

    def derivatives(self, lifted: LiftedRows) -> Derivatives:
        """Return the derivatives of the rows of :meth:`lift` over ``(x, z)``."""
        nx, row, column = self.x.numel(), 0, 0
        rows, sides, columns = dict[int, range](), dict[int, range](), dict[int, range]()
        pieces: dict[int, LiftedRows] = {}
        for whole in lifted.pieces:
            own = whole.pieces or (whole,)
            for kind, places in (("rows", rows), ("sides", sides)):
                for piece in own:
                    size = getattr(piece, kind).numel()
                    places[id(piece.rows)] = range(row, row + size)
                    row += size
            for piece in own:
                if piece.rows.numel():
                    pieces[id(piece.rows)] = piece
                columns[id(piece.rows)] = range(column, column + piece.variables.numel())
                column += piece.variables.numel()
        self._differentiate(list(pieces.values()))
        # There may be no rows, but there is always x.
        parts, order = [Derivatives(ca.SX(0, 1), ca.SX(0, nx), ca.SX(nx, nx))], list[int]()
        at = [k for _, block in self._blocks for piece in block for k in columns[id(piece.rows)]]
        for found, block in self._blocks:
            present = [pieces[id(piece.rows)] for piece in block]
            parts.append(_with_sides(found, [self._of_sides(piece) for piece in present], nx))
            order += [k for places in (rows, sides) for piece in present for k in places[id(piece.rows)]]
        J, H = _stacked(parts, nx)
        new_columns = [*range(nx), *(nx + np.argsort(at)).tolist()]
        multipliers = ca.vertcat(*[part.multipliers for part in parts])
        new_rows = np.argsort(order).tolist()
        return Derivatives(multipliers[new_rows], J[new_rows, new_columns], H[new_columns, new_columns])

    def _of_sides(self, piece: LiftedRows) -> Derivatives:
        """Differentiate the sides of a piece, which are another object where they change."""
        if piece not in self._sides:
            self._sides[piece] = Derivatives.of(piece.sides, piece.variables)
        return self._sides[piece]

    def _differentiate(self, pieces: list[LiftedRows]) -> None:
        """Differentiate the pieces that are new, together, because they share expressions."""
        known = {id(piece.rows) for _, block in self._blocks for piece in block}
        new = [piece for piece in pieces if id(piece.rows) not in known]
        if new:
            unknowns = ca.vertcat(self.x, *[piece.variables for piece in new])
            self._blocks.append((Derivatives.of(ca.vertcat(*[piece.rows for piece in new]), unknowns), new))


def _with_sides(found: Derivatives, below: list[Derivatives], nx: int) -> Derivatives:
    """Add rows that see only the auxiliaries of one piece each."""
    jacobian = ca.diagcat(*[part.jacobian for part in below])
    hessian = ca.diagcat(ca.SX(nx, nx), *[part.hessian for part in below])
    return Derivatives(
        ca.vertcat(found.multipliers, *[part.multipliers for part in below]),
        ca.vertcat(found.jacobian, ca.horzcat(ca.SX(jacobian.shape[0], nx), jacobian)),
        found.hessian + hessian,
    )


def _stacked(parts: list[Derivatives], nx: int) -> tuple[ca.SX, ca.SX]:
    """Return the Jacobian and the Hessian of parts with the same x and auxiliaries of their own."""
    J = ca.horzcat(ca.vertcat(*[p.jacobian[:, :nx] for p in parts]), ca.diagcat(*[p.jacobian[:, nx:] for p in parts]))
    both = ca.horzcat(*[p.hessian[:nx, nx:] for p in parts])
    H = ca.vertcat(
        ca.horzcat(sum((p.hessian[:nx, :nx] for p in parts), ca.SX(nx, nx)), both),
        ca.horzcat(both.T, ca.diagcat(*[p.hessian[nx:, nx:] for p in parts])),
    )
    return J, H


def joined(one: Derivatives, other: Derivatives, nx: int) -> Derivatives:
    """Return the derivatives of the rows of both, which share x alone."""
    return Derivatives(ca.vertcat(one.multipliers, other.multipliers), *_stacked([one, other], nx))
