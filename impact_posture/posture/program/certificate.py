"""Check from Pinocchio's numbers, not from those of the solver, whether a posture solves the problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.config.json_block import json_block
from impact_posture.dynamics.chart import Chart
from impact_posture.dynamics.numeric import Numeric
from impact_posture.posture.constraints.constraint import Linearization
from impact_posture.posture.constraints.posture_distance import distance_gradient
from impact_posture.posture.program.constrained_problem import RANK_TOLERANCE, ConstrainedProblem, held_rows
from impact_posture.system.arrays import Array, null_space

# An inequality closer than this (m, rad) may have a multiplier.  The product of both is the complementarity.
_ACTIVE = 1e-3
# Members of a maximum count if they are at most this share of f₀ below it.  The tolerance of the solver is a share of
# f₀ as well, and large for an objective that fell by orders of magnitude.  Complementarity allows twice this gap.
_TIED = 5e-8
# Weight of complementarity beside stationarity: the ratio of their tolerances.
_COMPLEMENTARITY = 10.0
# A violation above this (m, rad) is far from what certifies.
_HOPELESS = 1e-4
# A multiplier below this is rounding.
_MULTIPLIER = 1e-6


@dataclass(frozen=True)
class Active:
    """An active inequality.

    Attributes:
        constraint: Name, such as ``joint 'elbow'``.
        side: ``lower`` or ``upper``.
        multiplier: Rise of the scaled objective per unit of the bound, ≥ 0.
    """

    constraint: str
    side: str
    multiplier: float


@dataclass(frozen=True)
class Certificate:
    """First-order optimality and feasibility at one posture, recomputed.

    Attributes:
        stationarity: ``‖∇f/f₀ + Aᵀλ‖_∞`` over the tangent space, f₀ the initial objective, at the best multipliers
            with the right signs.
        primal: Largest violation of any constraint, limit or unit norm (m, rad).
        complementarity: Largest ``|multiplier × distance from its bound|``.
        pose_error_m: Largest position error of a held frame, meters.
        pose_error_rad: Largest orientation error of a held frame, radians.
        limits: Largest violation of a joint limit, rad or m.
        recomputed_with: Software that computed it.
        active: Inequalities with a multiplier.
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
        self,
        *,
        stationarity: float = 1e-6,
        complementarity: float = 1e-7,
        pose: float = 1e-6,
        primal: float = 1e-8,
    ) -> bool:
        """Return whether every number is within its tolerance."""
        return (
            self.stationarity <= stationarity
            and self.primal <= primal
            and self.complementarity <= complementarity
            and max(self.pose_error_m, self.pose_error_rad) <= pose
        )

    def to_dict(self) -> dict[str, object]:
        """Return the ``certificate`` block of ``result.json``."""
        return {key: value for key, value in json_block(self).items() if key != "active"}


def certify(
    problem: ConstrainedProblem,
    q: Array,
    scale: float,
    auxiliaries: Array | None = None,
    numeric: Numeric | None = None,
) -> Certificate:
    """Certify ``q``.

    Args:
        problem: The posture problem.
        q: The posture, shape (nq,).
        scale: The initial objective f₀.
        auxiliaries: Auxiliaries of the constraints at ``q``; by default the guesses of the constraints.
        numeric: The model, if the caller has it; it is moved to ``q``.
    """
    numeric = (numeric or Numeric(problem.robot.model)).at(q)
    gradients, gaps = objective_gradients(problem, q, scale)
    own = problem.guess(numeric).values if auxiliaries is None else auxiliaries
    parts = [c.linearize(numeric, z) for c, z in zip(problem.constraints, problem.split(own), strict=True)]
    errors = [c.pose_error(part.value) for c, part in zip(problem.constraints, parts, strict=True)]
    rows = Linearization.joined(parts, problem.robot.nv)
    jacobian = np.hstack([rows.posture, rows.auxiliary])
    violation = float(np.maximum(rows.lower - rows.value, rows.value - rows.upper).max(initial=0.0))
    equal = rows.lower == rows.upper

    def padded(tangent: Array) -> Array:
        """Add zeros for the auxiliaries to tangent rows, or to one."""
        return np.concatenate([tangent, np.zeros((*tangent.shape[:-1], rows.auxiliary.shape[1]))], axis=-1)

    limits, limit_violation = _limits(problem, q)
    near: list[_Near] = []
    # No multiplier makes a posture that is far outside a solution, and to find the best ones takes long.
    if violation <= _HOPELESS:
        for row in np.flatnonzero(~equal):
            bounds = rows.value[row], rows.lower[row], rows.upper[row]
            near += _near_bounds(rows.names[row], *bounds, jacobian[row])
        near += [replace(limit, outward=padded(limit.outward)) for limit in limits]
    equalities = np.vstack([padded(held_rows(problem.robot, problem.requirements.hold)), jacobian[equal]])
    weights, multipliers, residual = _multipliers(padded(gradients), equalities, near)
    products = [abs(float(m) * row.slack) for row, m in zip(near, multipliers, strict=True)]
    return Certificate(
        stationarity=float(np.abs(residual).max()),
        primal=max(violation, limit_violation),
        complementarity=max([*products, float(weights @ gaps)]),
        pose_error_m=max((e[0] for e in errors), default=0.0),
        pose_error_rad=max((e[1] for e in errors), default=0.0),
        limits=limit_violation,
        recomputed_with=f"pinocchio {pin.__version__}",
        active=_active(near, multipliers),
    )


def _active(near: Sequence[_Near], multipliers: Array) -> tuple[Active, ...]:
    """Inequalities with a multiplier; rows of one name are one, and a row without a name belongs to another."""
    found: dict[tuple[str, str], float] = {}
    for row, multiplier in zip(near, multipliers, strict=True):
        if row.name and multiplier > _MULTIPLIER:
            found[row.name, row.side] = found.get((row.name, row.side), 0.0) + float(multiplier)
    return tuple(Active(*key, multiplier) for key, multiplier in found.items())


def objective_gradients(problem: ConstrainedProblem, q: Array, scale: float) -> tuple[Array, Array]:
    """Return vectors that span the subdifferential of objective/scale plus the regularization.

    Returns:
        Tangent gradients, shape (k, nv), with k = 1 where the objective is smooth; gaps of their values, shape (k,).
    """
    found = problem.objective.subgradients(q, _TIED * scale)
    gradients = found.gradients / scale
    weight = problem.requirements.regularization
    if weight:
        gradients = gradients + weight * distance_gradient(Chart.of(problem.robot.model), q, problem.given)
    return gradients, found.gaps / scale


@dataclass(frozen=True, eq=False)
class _Near:
    """An inequality close to its bound, with its outward tangent gradient and its distance."""

    name: str
    side: str
    outward: Array
    slack: float


def _near_bounds(name: str, value: float, low: float, high: float, gradient: Array) -> list[_Near]:
    """The bounds of a scalar that are near, given its tangent gradient."""
    sides = _Near(name, "lower", -gradient, float(value - low)), _Near(name, "upper", gradient, float(high - value))
    return [side for side in sides if side.slack < _ACTIVE]


def _limits(problem: ConstrainedProblem, q: Array) -> tuple[list[_Near], float]:
    """Joint limits that are near, and the largest violation of all limits."""
    chart = Chart.of(problem.robot.model)
    in_v, in_x = chart.bounded
    x, low, high = chart.to_x(q)[in_x], problem.lower[in_x], problem.upper[in_x]
    near: list[_Near] = []
    # A held joint is an equality.
    for k in np.flatnonzero((np.minimum(x - low, high - x) < _ACTIVE) & (low != high)):
        unit = np.zeros(problem.robot.nv)
        unit[in_v[k]] = 1.0
        name = next(slot.name for slot in chart.slots if slot.v.start <= in_v[k] < slot.v.stop)
        near += _near_bounds(f"joint '{name}'", x[k], low[k], high[k], unit)
    return near, float(np.maximum(low - x, x - high).max(initial=0.0))


def _multipliers(gradients: Array, equalities: Array, near: Sequence[_Near]) -> tuple[Array, Array, Array]:
    """Weights of the gradients (≥ 0, sum 1) and multipliers of the inequalities (≥ 0) with the least residual.

    Multipliers of equalities have any sign, so all gradients are projected onto the null space of the equalities.
    The product of each multiplier and its slack is a residual as well.  Else a row that is near and not active could
    take the part of an active one.

    Returns:
        Weights, multipliers and residual.
    """
    count = len(gradients)
    free = null_space(equalities, RANK_TOLERANCE)
    reduced = gradients @ free
    if not free.shape[1] or (count == 1 and not near):
        return np.eye(count)[0], np.zeros(len(near)), free @ reduced[0]
    bounds = np.array([row.outward for row in near]).reshape(len(near), len(free)) @ free
    slack = np.diag([_COMPLEMENTARITY * row.slack for row in near])
    if count == 1:
        right = np.concatenate([-reduced[0], np.zeros(len(near))])
        multipliers = nonnegative_least_squares(np.vstack([bounds.T, slack]), right)
        return np.ones(1), multipliers, free @ (reduced[0] + bounds.T @ multipliers)
    # A row with the sum 1 scales the solution, and does not turn the least residual.
    left = np.vstack([reduced.T, np.zeros((len(near), count)), np.ones(count)])
    system = np.hstack([left, np.vstack([bounds.T, slack, np.zeros(len(near))])])
    found = nonnegative_least_squares(system, np.eye(len(system))[-1])
    found = found / found[:count].sum()
    weights, multipliers = found[:count], found[count:]
    return weights, multipliers, free @ (reduced.T @ weights + bounds.T @ multipliers)


def nonnegative_least_squares(matrix: Array, right: Array) -> Array:
    """Return the ``x ≥ 0`` with the least ``‖A x − b‖`` (Lawson and Hanson 1974, algorithm NNLS).

    SciPy has the same function, but takes longer to import than many problems take to solve.
    """
    x, passive = np.zeros(matrix.shape[1]), np.zeros(matrix.shape[1], dtype=bool)
    least = 10 * max(matrix.shape) * np.finfo(float).eps * float(np.abs(matrix).sum(axis=0).max(initial=0.0))
    # A cycle of rounding errors would not end, and three turns an unknown are plenty.
    for _ in range(3 * len(x)):
        slope = np.where(passive, -np.inf, matrix.T @ (right - matrix @ x))
        if passive.all() or slope.max() <= least:
            break
        passive[slope.argmax()] = True
        while (trial := _unbounded(matrix, right, passive))[passive].min(initial=np.inf) <= 0:
            # Go towards the trial until the first entry is zero, which then stays there.
            falling = passive & (trial <= 0)
            step = (x[falling] / np.maximum(x[falling] - trial[falling], np.finfo(float).tiny)).min()
            x += step * (trial - x)
            passive &= x > least
        x = trial
    return x


def _unbounded(matrix: Array, right: Array, passive: NDArray[np.bool_]) -> Array:
    x = np.zeros(len(passive))
    x[passive] = np.linalg.lstsq(matrix[:, passive], right, rcond=None)[0]
    return x
