"""Compare the CasADi and Pinocchio forms of a constraint, and their Jacobians with finite differences."""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca
import numpy as np
import pinocchio as pin

from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import Constraint, ExpressionConstraint
from tests.support.helpers import Vector, assert_close, rng
from tests.support.pinocchio_values import central_gradient


def check_expression(
    constraint: ExpressionConstraint, model: pin.Model, postures: Iterable[Vector], turns: slice = slice(0)
) -> None:
    """Check the value and the Jacobian of ``c(q)``.

    The rows ``turns`` belong to a quaternion, so the check also accepts them with the opposite sign.
    """
    chart, numeric = Chart(model), Numeric(model)
    x, p = ca.SX.sym("x", chart.nx), ca.SX.sym("p", constraint.parameters.size)
    symbolic = ca.Function("c", [x, p], [constraint.symbolic(Tree(model, chart.configuration(x), x), p)])
    for q in postures:
        value, jacobian = constraint.evaluate(numeric.at(q))
        expression = np.array(symbolic(chart.to_x(q), constraint.parameters)).reshape(-1)
        flipped = expression.copy()
        flipped[turns] *= -1
        assert min(np.abs(expression - value).max(), np.abs(flipped - value).max()) < 1e-12
        slopes = central_gradient(lambda there: constraint.evaluate(numeric.at(there))[0], model, q, 1e-4)
        np.testing.assert_allclose(jacobian, slopes, atol=2e-8)


def check_lifted_rows(constraint: Constraint, model: pin.Model, q: Vector, z: Vector) -> None:
    """Check lifted rows at a posture and its auxiliary variables: values, bounds, and both Jacobians."""
    chart, numeric = Chart(model), Numeric(model)
    x, p = ca.SX.sym("x", chart.nx), ca.SX.sym("p", constraint.parameters.size)
    lifted = constraint.lift(Tree(model, chart.configuration(x), x), p)
    program = ca.Function("rows", [x, lifted.variables, p], [lifted.rows])
    rows = np.array(program(chart.to_x(q), z, constraint.parameters)).ravel()
    linear = constraint.linearize(numeric.at(q), z)
    assert_close(rows, linear.value[: rows.size], 1e-10, "rows", 1.0)
    assert len(linear.names) == len(linear.value)
    for bounds, of_program in zip((linear.lower, linear.upper), constraint.lifted_bounds, strict=True):
        assert (bounds[: rows.size] == of_program).all()
    slopes = central_gradient(lambda there: constraint.linearize(numeric.at(there), z).value, model, q, 1e-3)
    assert_close(linear.posture, slopes, 1e-8, "by posture", 1e-3)
    step = rng("auxiliaries", z.size).normal(size=z.size)
    moved = constraint.linearize(numeric.at(q), z + step).value
    assert_close(linear.value + linear.auxiliary @ step, moved, 1e-9, "by auxiliaries", 1.0)
