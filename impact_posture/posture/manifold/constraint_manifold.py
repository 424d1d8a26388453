"""The constraint manifold of a posture problem, evaluated at many postures at once.

The functions of the program evaluate one posture at a time.  Here, a batch of postures is evaluated, and NumPy solves
the small linear systems of the batch together.  The evaluation takes about 0.1 ms for each posture of talos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.chart import Chart, JointSlot
from impact_posture.dynamics.numeric import Numeric
from impact_posture.dynamics.spatial import quaternion_matrix
from impact_posture.dynamics.tree import Tree
from impact_posture.posture.constraints.constraint import ExpressionConstraint
from impact_posture.posture.manifold.batch_function import BatchFunction
from impact_posture.posture.manifold.feasible_start import BASE_SPREAD, ROUNDING, draw_ranges, near_steps
from impact_posture.posture.program.constrained_problem import ConstrainedProblem, held_rows
from impact_posture.system.arrays import Array

_CONVERGED = 1e-10
_LONGEST_STEP = 0.5
# Weight of the squared violation of an inequality in the merit of a posture, 1/m² or 1/rad².
_PENALTY = 200.0
# Fraction of the random postures that are drawn near a given posture.
_NEAR = 0.25


@dataclass(frozen=True)
class Projected:
    """Projected postures in chart coordinates.

    Attributes:
        x: Postures, shape (N, nx).
        converged: Whether each posture satisfies the equalities, shape (N,).
    """

    x: Array
    converged: NDArray[np.bool_]


@dataclass(frozen=True)
class MeritEvaluation:
    """Equalities and merit at postures.

    Attributes:
        equalities: Values ``c``, shape (N, m).
        jacobian: Tangent Jacobian of the equalities, shape (N, m, nv).
        merit: ``ln f + μ Σ e²``, shape (N,), with the objective ``f`` and the violations ``e`` of the inequalities
            onto which postures are projected.  The merit is not finite where the objective is not defined.
        gradient: Tangent gradient of the merit, shape (N, nv).
    """

    equalities: Array
    jacobian: Array
    merit: Array
    gradient: Array


class ConstraintManifold:
    """The set ``{q : c(q) = 0}`` for the equalities of a problem with an impact objective.

    A posture is given by chart coordinates ``x``, a motion by a tangent vector ``v``.  Postures that differ by full
    turns of joints are the same.  A joint whose range is at least a full turn therefore has no limit, and its entries
    of ``lower`` and ``upper``, shape (nx,), are infinite.  The equalities leave at least ``free`` degrees of freedom.
    """

    def __init__(self, problem: ConstrainedProblem) -> None:
        model = problem.robot.model
        self.problem, self.chart = problem, Chart(model)
        x, v = ca.SX.sym("x", self.chart.nx), ca.SX.sym("v", self.chart.nv)
        tree = Tree(model, self.chart.configuration(x), x)
        motion = _tangent_map(self.chart.slots, tree.q, self.chart.nx)
        held = held_rows(problem.robot, problem.requirements.hold)
        # A constraint with auxiliaries has no expression in q alone, so it is treated as an inequality.
        equalities = [
            c for c in problem.constraints if isinstance(c, ExpressionConstraint) and c.equality and c.projected
        ]
        equal = ca.vertcat(ca.SX(0, 1), *[c.symbolic(tree, ca.SX(ca.DM(c.parameters))) for c in equalities])
        self._inequalities = [c for c in problem.constraints if c not in equalities]
        jacobian = ca.vertcat(ca.jacobian(equal, x) @ motion, held)
        self.free = self.chart.nv - jacobian.shape[0]
        rows = [ca.vertcat(equal, ca.SX(len(held), 1)), jacobian]
        self._equalities = BatchFunction([x], rows)
        objective = list(problem.impact.gradient_fun()(tree.q, ca.DM(problem.impact.contact.normal)))
        self._objective = BatchFunction([x], objective)
        penalty = self._penalty(tree)
        self._all = BatchFunction([x], [*rows, *objective, penalty, motion.T @ ca.gradient(penalty, x)])
        self._moved = BatchFunction([x, v], [_normalized(self.chart, x + motion @ v)])
        self._turning = np.zeros(self.chart.nx, dtype=bool)
        self.lower, self.upper = problem.lower.copy(), problem.upper.copy()
        for slot in self.chart.slots:
            # Coupled joints keep their limits, because a full turn would move the joints coupled to them.
            if slot.kind.family in ("revolute", "continuous") and slot.name not in problem.robot.coupled_joints:
                k = slot.x.start
                self._turning[k] = self.upper[k] - self.lower[k] >= 2 * np.pi
        limited = np.isfinite(self.lower) & np.isfinite(self.upper)
        self._middle = np.where(limited, self.lower, 0.0) / 2 + np.where(limited, self.upper, 0.0) / 2
        self.lower[self._turning], self.upper[self._turning] = -np.inf, np.inf

    def equalities(self, x: Array) -> tuple[Array, Array]:
        """Return ``c``, shape (N, m), and its tangent Jacobian, shape (N, m, nv)."""
        value, jacobian = self._equalities(x)
        return value[:, :, 0], jacobian

    def objective(self, x: Array) -> tuple[Array, Array]:
        """Return the objective, shape (N,), and its tangent gradient, shape (N, nv)."""
        value, gradient = self._objective(x)
        return value[:, 0, 0], gradient[:, :, 0]

    def evaluate(self, x: Array) -> MeritEvaluation:
        """Evaluate equalities and merit, which share most operations."""
        equalities, jacobian, objective, gradient, penalty, slope = self._all(x)
        with np.errstate(all="ignore"):
            merit, gradient = np.log(objective[:, 0, 0]) + penalty[:, 0, 0], gradient / objective + slope
        return MeritEvaluation(equalities[:, :, 0], jacobian, merit, gradient[:, :, 0])

    def _penalty(self, tree: Tree) -> ca.SX:
        terms = ca.SX(0)
        for constraint in self._inequalities:
            if isinstance(constraint, ExpressionConstraint) and constraint.projected:
                value = constraint.symbolic(tree, ca.SX(ca.DM(constraint.parameters)))
                for bounds, sign in ((constraint.lower, -1.0), (constraint.upper, 1.0)):
                    rows = np.flatnonzero(np.isfinite(bounds)).tolist()
                    if not rows:
                        continue
                    excess = ca.fmax(sign * (value[rows] - ca.DM(bounds[rows])), 0)
                    terms += _PENALTY * ca.dot(excess, excess)
        return terms

    def distance_to_feasible(self, x: Array) -> Array:
        """Return the first-order distance to the set that satisfies limits and inequalities, shape (N,)."""
        outside = np.maximum(np.maximum(self.lower - x, x - self.upper), 0.0).max(axis=1, initial=0.0)
        numeric = Numeric(self.problem.robot.model)
        for k in range(len(x) if self._inequalities else 0):
            numeric.at(self.to_q(x[k]))
            for constraint in self._inequalities:
                value, jacobian = constraint.evaluate(numeric)
                slopes = np.maximum(np.linalg.norm(jacobian, axis=1), 1e-9)
                outside[k] = max(outside[k], float((np.abs(constraint.excess(value)) / slopes).max()))
        return np.asarray(outside)

    def draw(self, rng: np.random.Generator, count: int, near: Array) -> Array:
        """Draw postures, shape (N, nx), a quarter of them near the posture ``near``, shape (nq,).

        The other postures lie anywhere within the limits.  All postures may violate the constraints.
        """
        ranges, base = draw_ranges(self.problem, self.chart), self.problem.robot.first_joint
        x = np.tile(self.chart.to_x(self.problem.given), (count, 1))
        x[:, ranges.entries] = rng.uniform(ranges.lower, ranges.upper, (count, len(ranges.entries)))
        step = np.zeros((count, self.chart.nv))
        step[:, :base] = rng.normal(size=(count, base)) * BASE_SPREAD[:base]
        close = rng.random(count) < _NEAR
        x[close] = self.chart.to_x(near)
        step[close] = near_steps(rng, (int(close.sum()), self.chart.nv), base)
        return self.move(x, step)

    def tangents(self, x: Array, dimension: int) -> Array:
        """Return an orthonormal basis of the tangent space of the manifold, shape (N, dimension, nv)."""
        return np.asarray(np.linalg.svd(self.equalities(x)[1])[2][:, self.chart.nv - dimension :])

    def move(self, x: Array, v: Array) -> Array:
        """Return postures moved by tangent vectors, shape (N, nv), without full turns of joints.

        The motion of a floating base is accurate to first order.
        """
        moved = self._moved(x, v)[0][:, :, 0]
        turns = np.where(self._turning, np.floor((moved - self._middle + np.pi) / (2 * np.pi)), 0.0)
        return np.asarray(moved - 2 * np.pi * turns)

    def project(self, x: Array, steps: int = 20, *, within: bool = False, tolerance: float = _CONVERGED) -> Projected:
        """Project postures, shape (N, nx), onto the equalities by Gauss–Newton steps of least norm.

        If ``within`` is true, the postures also stay within the joint limits; joints at a limit slide along it.
        ``tolerance`` is the largest violation of an equality, m or rad, at which a projection ends.
        """
        x = np.clip(x, self.lower, self.upper) if within else x.copy()
        value, jacobian = self.equalities(x)
        residual = np.abs(value).max(axis=1, initial=0.0)
        for _ in range(steps):
            left = np.flatnonzero(residual > tolerance)
            if not left.size:
                break
            inverse = right_inverse(jacobian[left])
            x[left] = self.move(x[left], self.back(x[left], value[left], jacobian[left], inverse, within=within))
            if within:
                x[left] = np.clip(x[left], self.lower, self.upper)
            value[left], jacobian[left] = self.equalities(x[left])
            residual[left] = np.abs(value[left]).max(axis=1, initial=0.0)
        return Projected(x, residual <= tolerance)

    def back(self, x: Array, value: Array, jacobian: Array, inverse: Array, *, within: bool = True) -> Array:
        """Return the Gauss–Newton steps to the equalities, shape (N, nv), shortened to the longest step.

        ``inverse`` is the right inverse of ``jacobian``.  With ``within``, joints at a limit do not leave it.
        """
        step = -times(inverse, value)
        at_limit = self.blocked(x, step) if within else np.zeros(step.shape, dtype=bool)
        again = np.flatnonzero(at_limit.any(axis=1))
        if again.size:
            free = np.where(at_limit[again, None, :], 0.0, jacobian[again])
            step[again] = -times(right_inverse(free), value[again])
        size = np.linalg.norm(step, axis=1, keepdims=True)
        return np.asarray(step * np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-300)))

    def blocked(self, x: Array, direction: Array) -> NDArray[np.bool_]:
        """Return a mask, shape (N, nv), of the joints that ``direction`` would move beyond a limit."""
        in_v, in_x = (np.array(places, dtype=int) for places in self.chart.bounded)
        at, along = x[:, in_x], direction[:, in_v]
        blocked = np.zeros(direction.shape, dtype=bool)
        at_low, at_high = at <= self.lower[in_x] + 1e-9, at >= self.upper[in_x] - 1e-9
        blocked[:, in_v] = (at_low & (along < 0)) | (at_high & (along > 0))
        return blocked

    def embed(self, x: Array) -> Array:
        """Map postures to points, shape (N, k), such that near postures and their points have equal distances."""
        parts = [np.zeros((len(x), 0))]
        for slot in self.chart.slots:
            piece = x[:, slot.x]
            if slot.kind.family in ("free-flyer", "spherical"):
                # The Frobenius norm of the difference of two rotation matrices is √8 sin(angle/2).
                parts += [piece[:, :-4], _rotations(piece[:, -4:]) / np.sqrt(2)]
            elif slot.kind.family in ("revolute", "continuous", "planar"):
                parts += [piece[:, :-1], np.cos(piece[:, -1:]), np.sin(piece[:, -1:])]
            else:
                parts.append(piece)
        return np.concatenate(parts, axis=1)

    def to_q(self, x: Array) -> Array:
        """Return the configuration of one posture, shape (nq,)."""
        return self.chart.to_q(x)


def right_inverse(jacobian: Array) -> Array:
    """Return ``Jᵀ(JJᵀ)⁻¹`` for each Jacobian, shape (N, nv, m)."""
    gram = jacobian @ jacobian.transpose(0, 2, 1)
    rows = np.arange(gram.shape[1])
    # The matrix may be singular: rows can be duplicates, and rows of a planar arm can be zero.
    gram[:, rows, rows] += ROUNDING * np.maximum(1.0, np.trace(gram, axis1=1, axis2=2))[:, None]
    return np.asarray(jacobian.transpose(0, 2, 1) @ np.linalg.inv(gram))


def times(matrices: Array, vectors: Array) -> Array:
    """Return the product of each matrix, shape (N, k, m), and vector, shape (N, m); the result has shape (N, k)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _tangent_map(slots: Sequence[JointSlot], q: ca.SX, nx: int) -> ca.SX:
    """Return the derivative ``∂x/∂v`` of the chart coordinates, shape (nx, nv)."""
    dx_dv = ca.SX(nx, slots[-1].v.stop)
    for slot in slots:
        piece, family = q[slot.q], slot.kind.family
        if family in ("free-flyer", "spherical"):
            x, y, z, w = (piece[piece.numel() - 4 + i] for i in range(4))
            half = ca.blockcat([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) / 2
            dx_dv[slot.x.stop - 4 : slot.x.stop, slot.v.stop - 3 : slot.v.stop] = half
            if family == "free-flyer":
                dx_dv[slot.x.start : slot.x.start + 3, slot.v.start : slot.v.start + 3] = quaternion_matrix(piece[3:])
        elif family == "planar":
            c, s = piece[2], piece[3]
            dx_dv[slot.x, slot.v] = ca.blockcat([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        else:
            dx_dv[slot.x, slot.v] = ca.SX.eye(slot.v.stop - slot.v.start)
    return dx_dv


def _normalized(chart: Chart, x: ca.SX) -> ca.SX:
    for part in chart.quaternion_slices():
        x[part] = x[part] / ca.norm_2(x[part])
    return x


def _rotations(quaternions: Array) -> Array:
    """Return the rotation matrices of unit quaternions x y z w, shape (N, 9)."""
    v, w = quaternions[:, :3], quaternions[:, 3]
    cross = np.zeros((len(w), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[:, i, j], cross[:, j, i] = -v[:, k], v[:, k]
    rotations = np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross
    return np.asarray(rotations.reshape(-1, 9))
