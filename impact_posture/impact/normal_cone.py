"""The worst normal within a cone: value, gradients, expressions and lifted form.

``impulse``, ``sticking`` and ``energy`` depend on the normal through one quadratic form ``nᵀK(q)n``
(:class:`~impact_posture.impact.impact_kind.QuadraticKind`), whose largest value over a cone is known exactly
(:mod:`impact_posture.impact.cone`).  ``speed`` is no such form and has no such dual.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.errors import InputError, MetricError
from impact_posture.impact.cone import WorstNormal, tied_normals, worst_normal
from impact_posture.impact.cone_symbolic import worst_normal_symbolic
from impact_posture.impact.impact_kind import ImpactKind, QuadraticKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.lifted_normal_cone import INSIDE, FormAlongAxes, guess_cone, lift_cone
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.impact.worst_case import Subgradients

Vector = NDArray[np.float64]

# Normals whose value is within this share of the largest count as worst ones in a subdifferential.
_ACTIVE = 1e-7


def check_cone(kind: ImpactKind, degrees: float) -> None:
    """Refuse what is no cone, and what has no exact worst case over one.

    Raises:
        InputError: No half angle of a cone.
        MetricError: A kind that is no quadratic form of the normal.
    """
    if not 0 <= degrees < 90:
        raise InputError(f"the half angle is {degrees:g}°", where="normal_cone", hint="give 0 to below 90 degrees")
    if degrees and not isinstance(kind, QuadraticKind):
        raise MetricError(
            kind.no_cone,
            where="normal_cone",
            hint="choose `objective='impulse'`, sticking or energy, or `normal_cone=0`",
        )


@dataclass(frozen=True)
class NormalCone:
    """The worst normal within ``degrees`` of the contact's own.

    Attributes:
        oracle: Pinocchio's numbers.
        kind: What is minimized.
        degrees: Half angle of the cone.
        attempts: Guesses of the lifted form.
    """

    oracle: ImpactOracle
    kind: QuadraticKind
    degrees: float
    attempts: int = len(INSIDE)

    @property
    def axis(self) -> Vector:
        """The contact's own normal, shape (3,)."""
        return np.array(self.oracle.contact.normal)

    def worst(self, q: Vector) -> WorstNormal:
        """The worst normal at ``q``, in the axes that the contact's normal is given in.

        Its ``value`` is that of the form ``nᵀKn``; :meth:`value` is the objective's.

        Raises:
            MetricError: ``sticking`` where the contact point cannot move in every direction.
        """
        return worst_normal(self._form(q), self.axis, self.degrees)

    def worst_in_world(self, q: Vector) -> WorstNormal:
        """:meth:`worst` with its normals in world axes."""
        found = self.worst(q)
        return found.turned(self._axes_in_world(q)) if self.oracle.case.in_contact_frame else found

    def value(self, q: Vector) -> float:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return float(self.kind.of_form(self.oracle.case, np.array(self.worst(q).value)))

    def gradient(self, q: Vector) -> Vector:
        """Tangent gradient at the worst normal, held fixed (Danskin); where tied, the named one's: a subgradient."""
        found = self.worst(q)
        slope = float(self.kind.of_form_slope(self.oracle.case, np.array(found.value)))
        return slope * self.kind.form_gradient(self.oracle, q, found.normal)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """Gradients at all worst normals, the named one first; of an arc or a circle of them a dense sample.

        Those whose objective is at most ``within`` below count as well.
        """
        case, kind, axis = self.oracle.case, self.kind, self.axis
        form = self._form(q)
        found = worst_normal(form, axis, self.degrees)
        size = max(float(np.abs(form).max() * kind.of_form_slope(case, np.array(found.value))), 1e-300)
        normals = tied_normals(form, axis, self.degrees, found, max(_ACTIVE, within / size))
        values = np.einsum("ki,ij,kj->k", normals, form, normals)
        slopes = kind.of_form_slope(case, values)
        gaps = np.maximum(kind.of_form(case, np.array(found.value)) - kind.of_form(case, values), 0.0)
        if len(normals) <= 2:
            gradients = np.array([kind.form_gradient(self.oracle, q, n) for n in normals])
        else:
            gradients = np.einsum("ki,ijv,kj->kv", normals, self._form_tensor(q), normals)
        return Subgradients(slopes[:, None] * gradients, gaps)

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """The single impact's along the worst normal, which the gradient holds fixed (Danskin)."""
        worst = ImpactKernel(k.case, k.q, self.worst_normal_expression(k), k.tree.repeated_limbs)
        return self.kind.expressions(worst)

    def worst_normal_expression(self, k: ImpactKernel) -> ca.SX:
        """The worst normal of a kernel's ``q`` and ``n`` in closed form, in the axes of ``n``, shape (3,)."""
        K = self.kind.form_expression(k)
        if k.case.in_contact_frame:
            R = k.tree.rotation(k.point)
            K = R.T @ K @ R
        return worst_normal_symbolic((K + K.T) / 2, k.n, self.degrees)

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return lift_cone(self.oracle.case, self.kind, self.degrees, tree, n, scale)

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return guess_cone(self.oracle, self.kind, self.degrees, q, scale, attempt)

    def _axes_in_world(self, q: Vector) -> Vector:
        return np.array(self.oracle.at(q).numeric.placement(self.oracle.point).rotation)

    def _form(self, q: Vector) -> Vector:
        return FormAlongAxes.at(self.oracle, self.kind, q, np.eye(3)).form

    def _form_tensor(self, q: Vector) -> Vector:
        """``∂K``, shape (3, 3, nv), from the gradients along six directions."""
        axes = np.eye(3)
        tensor = np.zeros((3, 3, self.oracle.robot.nv))
        for i in range(3):
            tensor[i, i] = self.kind.form_gradient(self.oracle, q, axes[i])
        for i, j in ((0, 1), (0, 2), (1, 2)):
            both = self.kind.form_gradient(self.oracle, q, axes[i] + axes[j])
            tensor[i, j] = tensor[j, i] = (both - tensor[i, i] - tensor[j, j]) / 2
        return tensor
