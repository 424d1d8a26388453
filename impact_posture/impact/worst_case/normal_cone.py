"""The worst normal within a cone: value, gradients, expressions and lifted form.

The objective types ``impulse``, ``sticking`` and ``energy`` increase with a quadratic form ``nᵀK(q)n``
(:class:`~impact_posture.impact.kinds.impact_kind.QuadraticKind`).  The largest value of this form over a cone can be
computed exactly (:mod:`impact_posture.impact.worst_case.worst_normal`).  The objective type ``speed`` does not depend
on the normal through a single quadratic form, and no exact worst normal is known for this type.

In the program, the dual problem replaces the maximum over the normals.  In the axes of the cone (half angle α), let
``P(q) = [a, bᵀ; b, C]`` be ``K(q)``, divided by the value of ``nᵀKn`` at the initial posture.  With ``c = cos α`` and
``s = sin α``, the program is::

    min t,   t = a + sτ,   Z = [τ − ρ, −bᵀ; −b, (st + ρc²) I − sC] = L²,   ρ ≥ 0

``Z`` equals ``D(tI − P − μ(n₀n₀ᵀ − c²I))D`` with ``D = diag(s^-½, s^½, s^½)`` and ``μ = ρ/s``.  The entries of
``Z`` stay bounded as α tends to zero.  At mirror-symmetric postures, two eigenvalues of ``Z`` are zero.  At these
postures the gradient of ``det Z`` vanishes, but the gradient of ``Z = L²`` with a symmetric ``L`` does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree
from impact_posture.errors import MetricError
from impact_posture.impact.kinds.impact_kind import ImpactKind, QuadraticKind
from impact_posture.impact.objective import Subgradients
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import Guess, Lifted, in_world
from impact_posture.impact.worst_case.worst_normal import WorstNormal, cone_axes, tied_normals, worst_normal
from impact_posture.impact.worst_case.worst_normal_symbolic import cone_axes_symbolic, worst_normal_symbolic
from impact_posture.system.arrays import Array

# A normal contributes a subgradient if its value is less than this fraction of |K| below the largest value.
_ACTIVE = 1e-7
# Offsets of the initial τ and ρ from their optimal values, for each attempt.  Without offsets, L would start with a
# zero eigenvalue, which is a saddle point for Newton's method.
_INSIDE = ((0.03, 0.01), (0.3, 0.1), (0.003, 0.001))
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def check_cone(kind: type[ImpactKind], degrees: float) -> None:
    """Raise ``MetricError`` if ``degrees`` > 0 and the objective type is not a :class:`QuadraticKind`."""
    if degrees and not issubclass(kind, QuadraticKind):
        hint = "choose `objective` impulse, sticking or energy, or `normal_cone` 0"
        raise MetricError(kind.no_cone, where="normal_cone", hint=hint)


@dataclass(frozen=True)
class NormalCone:
    """Worst case over all normals within the angle ``degrees`` of the normal of the contact."""

    kind: QuadraticKind
    degrees: float
    attempts: int = len(_INSIDE)

    @property
    def oracle(self) -> ImpactOracle:
        return self.kind.oracle

    @property
    def axis(self) -> Array:
        """Axis of the cone: the normal of the contact, shape (3,)."""
        return np.array(self.oracle.contact.normal)

    def worst(self, q: Array) -> WorstNormal:
        """Return the worst normal at ``q``, in the axes ``normal_frame`` of the contact.

        The attribute ``value`` of the result is ``nᵀKn``, not the objective.

        Raises:
            MetricError: The objective type is ``sticking``, and the contact point cannot move in some direction.
        """
        return worst_normal(self._form(q)[0], self.axis, self.degrees)

    def worst_in_world(self, q: Array) -> WorstNormal:
        """Return :meth:`worst` with normals in world axes."""
        return self.worst(q).turned(self.oracle.at(q).axes)

    def value(self, q: Array) -> float:
        return float(self.kind.of_form(np.array(self.worst(q).value)))

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return one gradient for each worst normal.

        Each gradient is computed for a fixed normal (Danskin's theorem).  A normal is included if its objective is at
        most ``within`` below the maximum.  If an arc or a circle of normals is included, it is sampled densely.
        """
        kind, axis = self.kind, self.axis
        form = self._form(q)[0]
        worst = worst_normal(form, axis, self.degrees)
        size = max(float(np.abs(form).max() * kind.of_form_slope(np.array(worst.value))), 1e-300)
        normals = tied_normals(form, axis, self.degrees, worst, max(_ACTIVE, within / size))
        values = np.einsum("ki,ij,kj->k", normals, form, normals)
        slopes = kind.of_form_slope(values)
        gaps = np.maximum(kind.of_form(np.array(worst.value)) - kind.of_form(values), 0.0)
        if len(normals) <= 2:
            gradients = np.array([kind.form_gradient(q, n) for n in normals])
        else:
            gradients = np.einsum("ki,ijv,kj->kv", normals, self._form_tensor(q), normals)
        return Subgradients(slopes[:, None] * gradients, gaps)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and gradient; the gradient treats the worst normal as constant (Danskin's theorem)."""
        R = in_world(k.case, k.tree, ca.SX.eye(3))
        K = R.T @ self.kind.form_expression(k) @ R
        n = worst_normal_symbolic((K + K.T) / 2, k.n, self.degrees)
        return self.kind.expressions(ImpactKernel(k.case, k.q, n, k.tree.limbs, k.tree.visits))

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the dual problem; its unknowns are three jumps, ``τ``, ``ρ`` and the six entries of ``L``."""
        kind, local = self.kind, cone_axes_symbolic(parameters)
        world = in_world(kind.case, tree, local)
        jumps = [kind.lift_direction(tree, local[:, k], str(k)) for k in range(3)]
        unit = kind.form_unit(scale)
        form = ca.SX.zeros(3, 3)
        for i, j in _UPPER:
            form[i, j] = form[j, i] = kind.lift_entry(world[:, i], jumps[i], jumps[j]) / unit
        tau, rho, root = ca.SX.sym("tau"), ca.SX.sym("rho"), ca.SX.sym("root", 6)
        c, s = self._cosine_sine
        t = form[0, 0] + s * tau
        block = (s * t + rho * c * c) * ca.SX.eye(2) - s * form[1:, 1:]
        L = ca.SX.zeros(3, 3)
        for k, (i, j) in enumerate(_UPPER):
            L[i, j] = L[j, i] = root[k]
        gap = ca.blockcat([[tau - rho, -form[0, 1:]], [-form[1:, 0], block]]) - L @ L
        return Lifted.of(
            jumps,
            kind.of_form_expression(unit * t),
            others=[tau, rho, root],
            equations=[gap[i, j] for i, j in _UPPER],
        )

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return initial values for the unknowns of :meth:`lift` at ``q``, for which ``Z`` is positive definite."""
        form, jumps, impulses = self._form(q, cone_axes(self.axis))
        form = form / self.kind.form_unit(scale)
        parts: list[Array] = []
        for jump, impulse in zip(jumps.T, impulses.T, strict=True):
            parts.append(self.oracle.with_support_impulses(jump))
            if self.kind.unknown_impulse:
                parts.append(impulse)
        c, s = self._cosine_sine
        worst = worst_normal(form, np.eye(3)[0], self.degrees)
        above, beyond = _INSIDE[attempt]
        tau, rho = (worst.value - form[0, 0]) / s + above + beyond, worst.multiplier * s + beyond
        Z = -s * form
        Z[0, :] = Z[:, 0] = Z[:, 0] / s
        Z[0, 0] = tau - rho
        Z[1:, 1:] += (s * (form[0, 0] + s * tau) + rho * c * c) * np.eye(2)
        values, vectors = np.linalg.eigh(Z)
        root = (vectors * np.sqrt(np.maximum(values, 1e-6))) @ vectors.T
        guess = Guess.unbounded(np.concatenate([*parts, [tau, rho], [root[i, j] for i, j in _UPPER]]))
        guess.lower[-1 - len(_UPPER)] = 0.0
        return guess

    @property
    def _cosine_sine(self) -> tuple[float, float]:
        alpha = np.deg2rad(self.degrees)
        return float(np.cos(alpha)), float(np.sin(alpha))

    def _form(self, q: Array, directions: Array | None = None) -> tuple[Array, Array, Array]:
        """Return ``K`` in the axes ``directions``, three velocity jumps, and the impulses that cause these jumps.

        ``directions`` are columns in the axes ``normal_frame`` of the contact, by default the identity.  ``K`` has
        shape (3, 3).  The jumps are columns, shape (nv, 3).  The impulses are columns in world axes, shape (3, 3).
        """
        world = self.oracle.at(q).axes
        if directions is not None:
            world = world @ directions
        responses = self.oracle.solve(self.oracle.J.T)
        mobility = self.oracle.J @ responses
        impulses = self.kind.directions(mobility, world)
        jumps = responses @ impulses
        K = self.kind.form(mobility, world, jumps)
        return (K + K.T) / 2, jumps, impulses

    def _form_tensor(self, q: Array) -> Array:
        """Return the tangent derivative of ``K``, shape (3, 3, nv), from the gradients for six directions."""
        axes = np.eye(3)
        tensor = np.zeros((3, 3, self.oracle.robot.nv))
        # Compute the diagonal entries first, because the other entries need them.
        for i, j in sorted(_UPPER, key=lambda entry: entry[0] != entry[1]):
            both = self.kind.form_gradient(q, axes[i] if i == j else axes[i] + axes[j])
            tensor[i, j] = tensor[j, i] = both if i == j else (both - tensor[i, i] - tensor[j, j]) / 2
        return tensor
