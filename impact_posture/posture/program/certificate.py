"""Check with Pinocchio, independently of the solver, whether a posture is a solution of the problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from impact_posture.config.json_block import JsonBlock
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraints.constraint import Linearization
from impact_posture.posture.constraints.posture_distance import distance_gradient
from impact_posture.posture.program.constrained_problem import RANK_TOLERANCE, ConstrainedProblem, held_rows
from impact_posture.system.arrays import Array, nonnegative_least_squares, null_space

# An inequality can have a multiplier only if the distance from its bound is below this value (m, rad).
_ACTIVE = 1e-3
# If the objective is a maximum, functions up to this fraction of the initial objective f₀ below the maximum
# contribute a gradient.  The tolerance of complementarity is twice this fraction.
_TIED = 5e-8
# Weight of complementarity relative to stationarity, equal to the ratio of the tolerances of the two.
_COMPLEMENTARITY = 10.0
# If the violation (m, rad) exceeds this value, no multipliers are computed, because the posture cannot be certified.
_HOPELESS = 1e-4
# A multiplier below this value is treated as a rounding error.
_MULTIPLIER = 1e-6


@dataclass(frozen=True)
class Active(JsonBlock):
    """An active inequality: a constraint, such as ``joint 'elbow'``, and its ``lower`` or ``upper`` side.

    ``multiplier`` (≥ 0) is the rate at which the scaled objective decreases if the bound is relaxed, per unit of the
    bound.
    """

    constraint: str
    side: str
    multiplier: float


@dataclass(frozen=True)
class Certificate(JsonBlock):
    """First-order optimality and feasibility at one posture, computed independently of the solver.

    Attributes:
        stationarity: Residual ``‖∇f/f₀ + Aᵀλ‖_∞`` in the tangent space.  Here f is the objective, f₀ its initial
            value, and A the Jacobian of constraints and limits.  The multipliers λ have the right signs and are
            computed by least squares.
        primal: Largest violation of a constraint or joint limit, or error of the norm of a quaternion (m, rad).
        complementarity: Largest product of a multiplier and the distance of the constraint value from the bound.
        pose_error_m: Largest position error of a frame whose position is constrained, m.
        pose_error_rad: Largest orientation error of a frame whose orientation is constrained, rad.
        limits: Largest violation of a joint limit, rad or m.
        recomputed_with: Library and version with which the certificate was computed.
        active: Inequalities with a positive multiplier.
    """

    stationarity: float
    primal: float
    complementarity: float
    pose_error_m: float
    pose_error_rad: float
    limits: float
    recomputed_with: str
    active: tuple[Active, ...]

    def holds(
        self, *, stationarity: float = 1e-6, complementarity: float = 1e-7, pose: float = 1e-6, primal: float = 1e-8
    ) -> bool:
        """Return whether every number is within its tolerance."""
        return (
            self.stationarity <= stationarity
            and self.primal <= primal
            and self.complementarity <= complementarity
            and max(self.pose_error_m, self.pose_error_rad) <= pose
        )

    @property
    def feasible(self) -> bool:
        """Whether the posture satisfies the constraints; it need not be optimal."""
        return replace(self, stationarity=0.0, complementarity=0.0).holds()

    def to_dict(self) -> dict[str, object]:
        """Return the ``certificate`` block of ``result.json``."""
        return {key: value for key, value in super().to_dict().items() if key != "active"}


def certify(
    problem: ConstrainedProblem,
    q: Array,
    scale: float,
    auxiliaries: Array | None = None,
    numeric: Numeric | None = None,
) -> Certificate:
    """Compute the certificate of the posture ``q``.

    ``scale`` is the initial objective f₀.  ``auxiliaries`` are the values of the auxiliary unknowns of the
    constraints at ``q``, by default :meth:`ConstrainedProblem.guess`.  If ``numeric`` is given, the function sets it
    to ``q``.
    """
    numeric = (numeric or Numeric(problem.robot.model)).at(q)
    gradients, gaps = objective_gradients(problem, q, scale)
    if auxiliaries is None:
        auxiliaries = problem.guess(numeric).values
    parts = [c.linearize(numeric, z) for c, z in zip(problem.constraints, problem.split(auxiliaries), strict=True)]
    errors = [c.pose_error(part.value) for c, part in zip(problem.constraints, parts, strict=True)]
    rows, limits = Linearization.joined(parts, problem.robot.nv), linearized_limits(problem, q)
    near: list[_NearBound] = []
    # If a posture violates the constraints, multipliers could not certify it and would take long to compute.
    if rows.violation <= _HOPELESS:
        near = _near_bounds(Linearization.joined([rows, limits], problem.robot.nv))
    jacobian = np.hstack([rows.posture, rows.auxiliary])
    width = rows.auxiliary.shape[1]
    gradients, held = (
        np.pad(tangent, ((0, 0), (0, width)))
        for tangent in (gradients, held_rows(problem.robot, problem.requirements.hold))
    )
    equalities = np.vstack([held, jacobian[rows.lower == rows.upper]])
    weights, multipliers, residual = _multipliers(gradients, equalities, near)
    products = [abs(float(m) * bound.slack) for bound, m in zip(near, multipliers, strict=True)]
    return Certificate(
        stationarity=float(np.abs(residual).max()),
        primal=max(rows.violation, limits.violation),
        complementarity=max([*products, float(weights @ gaps)]),
        pose_error_m=max((e[0] for e in errors), default=0.0),
        pose_error_rad=max((e[1] for e in errors), default=0.0),
        limits=limits.violation,
        recomputed_with=f"pinocchio {pin.__version__}",
        active=_active(near, multipliers),
    )


def objective_gradients(problem: ConstrainedProblem, q: Array, scale: float) -> tuple[Array, Array]:
    """Return the gradients, shape (k, nv), and the gaps, shape (k,), of :class:`Subgradients`, divided by ``scale``.

    The gradients include the regularization.  The convex combinations of the gradients are the subdifferential of the
    minimized function.  If the minimized function is smooth at ``q``, k = 1.
    """
    members = problem.objective.subgradients(q, _TIED * scale)
    gradients = members.gradients / scale
    weight = problem.requirements.regularization
    if weight:
        gradients = gradients + weight * distance_gradient(Chart.of(problem.robot.model), q, problem.given)
    return gradients, members.gaps / scale


@dataclass(frozen=True, eq=False)
class _NearBound:
    """One side of a nearly active inequality, with its outward gradient and the distance ``slack`` to its limit."""

    name: str
    side: str
    outward: Array
    slack: float


def _near_bounds(rows: Linearization) -> list[_NearBound]:
    gradients, near = np.hstack([rows.posture, rows.auxiliary]), list[_NearBound]()
    lower, upper = rows.value - rows.lower, rows.upper - rows.value
    for k in np.flatnonzero((np.minimum(lower, upper) < _ACTIVE) & (rows.lower != rows.upper)).tolist():
        sides = ("lower", -gradients[k], float(lower[k])), ("upper", gradients[k], float(upper[k]))
        near += [_NearBound(rows.names[k], *side) for side in sides if side[-1] < _ACTIVE]
    return near


def _active(near: Sequence[_NearBound], multipliers: Array) -> tuple[Active, ...]:
    """Return the inequalities with a multiplier; multipliers of rows with equal names are summed up.

    Rows without a name are left out, because they only complete a named row of the same constraint.
    """
    sums: dict[tuple[str, str], float] = {}
    for bound, multiplier in zip(near, multipliers, strict=True):
        if bound.name and multiplier > _MULTIPLIER:
            sums[bound.name, bound.side] = sums.get((bound.name, bound.side), 0.0) + float(multiplier)
    return tuple(Active(*key, multiplier) for key, multiplier in sums.items())


def linearized_limits(problem: ConstrainedProblem, q: Array) -> Linearization:
    """Return the rows of the joint limits at ``q``, shape (nq,)."""
    chart = Chart.of(problem.robot.model)
    in_v, in_x = chart.bounded
    names = [next(f"joint '{s.name}'" for s in chart.slots if s.v.start <= k < s.v.stop) for k in in_v]
    bounds = problem.lower[in_x], problem.upper[in_x]
    return Linearization(names, chart.to_x(q)[in_x], *bounds, np.eye(chart.nv)[in_v], np.zeros((len(in_v), 0)))


def _multipliers(gradients: Array, equalities: Array, near: Sequence[_NearBound]) -> tuple[Array, Array, Array]:
    """Return weights of ``gradients`` (≥ 0, sum 1), multipliers of ``near`` (≥ 0), and the least-squares residual.

    Multipliers of equalities can have any sign, so all gradients are projected onto the null space of the equalities.
    The products of multipliers and slacks are added to the residual.  Without these products, a nearby inactive bound
    could replace an active bound.
    """
    count = len(gradients)
    free = null_space(equalities, RANK_TOLERANCE)
    reduced = gradients @ free
    if not free.shape[1] or (count == 1 and not near):
        return np.eye(count)[0], np.zeros(len(near)), free @ reduced[0]
    bounds = np.array([bound.outward for bound in near]).reshape(len(near), len(free)) @ free
    slack = np.diag([_COMPLEMENTARITY * bound.slack for bound in near])
    if count == 1:
        right = np.concatenate([-reduced[0], np.zeros(len(near))])
        multipliers = nonnegative_least_squares(np.vstack([bounds.T, slack]), right)
        return np.ones(1), multipliers, free @ (reduced[0] + bounds.T @ multipliers)
    # An additional row requires that the sum of the weights is 1.  Least squares satisfies this row only
    # approximately, so the solution is then divided by the sum of the weights.
    left = np.vstack([reduced.T, np.zeros((len(near), count)), np.ones(count)])
    system = np.hstack([left, np.vstack([bounds.T, slack, np.zeros(len(near))])])
    solution = nonnegative_least_squares(system, np.eye(len(system))[-1])
    weights, multipliers = np.split(solution / solution[:count].sum(), [count])
    return weights, multipliers, free @ (reduced.T @ weights + bounds.T @ multipliers)
