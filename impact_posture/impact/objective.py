"""The :class:`Objective` protocol, through which the program and its solver use an objective."""

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
    """Gradients whose convex hull is the subdifferential of an objective.

    Attributes:
        gradients: Tangent gradients of the members of the maximum, one per row, shape (k, nv).
        gaps: Value of the objective minus the value of each member, ≥ 0, shape (k,).
    """

    gradients: Array
    gaps: Array

    @property
    def first(self) -> Array:
        """The gradient of the leading member, shape (nv,)."""
        return np.asarray(self.gradients[0])


class Minimized(Protocol):
    """A function of the posture that can be minimized: numeric value, subgradients, and lifted form."""

    @property
    def attempts(self) -> int:
        """Number of different initial guesses that :meth:`guess` offers."""

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return initial values at ``q`` for the auxiliaries of the lifted form, and their bounds."""

    def value(self, q: Array) -> float:
        """Return the value at ``q``, > 0, computed with Pinocchio.

        Raises:
            MetricError: The value does not exist at ``q``.
        """

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return gradients that span the subdifferential at ``q``, computed with Pinocchio.

        If the value is smooth at ``q``, the result is one gradient.  If the value is a maximum, the result includes
        the gradient of every member that is at most ``within`` below the maximum, the leading member first.
        """

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the value at ``tree.q`` as an expression of auxiliary unknowns, with the equations that define them.

        ``scale`` is a typical size of the value.
        """


class WorstCase(Minimized, Protocol):
    """The largest value that an uncertain impact can have at one posture.

    The argument ``parameters`` of :meth:`lift` is the normal of the leading contact.
    """

    @property
    def oracle(self) -> ImpactOracle:
        """The oracle of the leading contact for the robot as modeled."""

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and tangent gradient (nv) of the worst member, in the symbols of the kernel ``k``."""


class Objective(Minimized, Protocol):
    """The function that a posture problem minimizes, with the contacts and supports of the problem."""

    @property
    def robot(self) -> Robot:
        """The robot."""

    @property
    def name(self) -> str:
        """Name in outputs."""

    @property
    def contacts(self) -> tuple[ImpactContact, ...]:
        """Contacts whose frames the problem constrains; may be empty."""

    @property
    def supports(self) -> tuple[Support, ...]:
        """Feet that the problem keeps in place; may be empty."""

    @property
    def structure(self) -> str:
        """Text that, with the robot, identifies the expressions; it is part of the key of the compile cache."""

    @property
    def parameters(self) -> Array:
        """Parameters of the lifted form, shape (k,), which can change without rebuilding the program."""

    def movable(self, q: Array) -> bool:
        """Return whether the contact can move at ``q``; if not, the value consists of rounding errors."""

    def blind_motions(self) -> Array:
        """Return base twists that do not change the value, world axes, linear first, shape (k, 6)."""
