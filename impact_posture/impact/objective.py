"""The :class:`Objective` protocol: interface between an objective and the nonlinear program that minimizes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import Guess, Lifted
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.arrays import Array


@dataclass(frozen=True, eq=False)
class Subgradients:
    """Gradients whose convex hull is the subdifferential of a function ``f = max_i f_i``.

    Attributes:
        gradients: Tangent gradients of the functions ``f_i`` that are near the maximum, one per row, shape (k, nv).
        gaps: Difference ``f − f_i ≥ 0`` for each row, shape (k,).
    """

    gradients: Array
    gaps: Array

    @property
    def first(self) -> Array:
        """Gradient of the largest ``f_i``, shape (nv,)."""
        return np.asarray(self.gradients[0])


class Minimized(Protocol):
    """A function of the posture: numeric value, subgradients, and lifted form (:class:`Lifted`)."""

    @property
    def attempts(self) -> int:
        """Number of different initial guesses that :meth:`guess` offers."""

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return initial values at ``q``, with bounds, for the unknowns that :meth:`lift` adds."""

    def value(self, q: Array) -> float:
        """Return the value at ``q``, > 0, computed with Pinocchio.

        Raises:
            MetricError: The value does not exist at ``q``.
        """

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return gradients that span the subdifferential at ``q``, computed with Pinocchio.

        If the value is smooth at ``q``, the result is one gradient.  If the value is a maximum of functions, the
        result starts with the gradient of the largest function.  The gradients of all functions that are at most
        ``within`` below the maximum follow.
        """

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the value at ``tree.q`` as an expression of additional unknowns, with equations for them.

        ``scale`` is a typical size of the value.
        """


class WorstCase(Minimized, Protocol):
    """Largest value over all normals, impulses or robot models that an uncertain impact allows.

    The argument ``parameters`` of :meth:`lift` is the normal of the first contact.
    """

    @property
    def oracle(self) -> ImpactOracle:
        """Numeric impact quantities of the first contact for the nominal robot model."""

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return the objective and its tangent gradient, shape (nv,), as expressions of the symbols in ``k``."""


class Objective(Minimized, Protocol):
    """The function that a posture problem minimizes, with the contacts and supports of the problem."""

    @property
    def robot(self) -> Robot:
        """Robot that receives the impact."""

    @property
    def name(self) -> str:
        """Name of the objective in outputs."""

    @property
    def contacts(self) -> tuple[ImpactContact, ...]:
        """Contacts whose frames the problem constrains; may be empty."""

    @property
    def supports(self) -> tuple[Support, ...]:
        """Feet that the problem keeps in place; may be empty."""

    @property
    def structure(self) -> str:
        """Text that identifies the expressions for a given robot, as part of the key of the compile cache."""

    @property
    def parameters(self) -> Array:
        """Argument ``parameters`` of :meth:`lift`, shape (k,), which can change without rebuilding the program."""

    def movable(self, q: Array) -> bool:
        """Return whether the contact can move at ``q``; if not, the objective is only a rounding error."""

    def blind_motions(self) -> Array:
        """Return base twists that do not change the value, world axes, linear first, shape (k, 6)."""
