"""The :class:`Objective` protocol and its parts, the only interface of an objective to the program and its solver."""

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
    """Gradients whose convex hull is the subdifferential.

    Attributes:
        gradients: Tangent gradients of the members of a maximum, shape (k, nv).
        gaps: Objective minus the value of each member, ≥ 0, shape (k,).
    """

    gradients: Array
    gaps: Array

    @property
    def first(self) -> Array:
        """The gradient of the leading member, shape (nv,)."""
        return np.asarray(self.gradients[0])


class Minimized(Protocol):
    """A function of the posture with a numeric value, subgradients and a lifted form for the program."""

    @property
    def attempts(self) -> int:
        """Number of different guesses of :meth:`guess`."""

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return the initial auxiliaries of the lifted form at ``q``, and their bounds."""

    def value(self, q: Array) -> float:
        """Return the value at ``q``, > 0, computed with Pinocchio.

        Raises:
            MetricError: The value does not exist at ``q``.
        """

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return gradients that span the subdifferential at ``q``, computed with Pinocchio.

        There is one gradient where the value is smooth.  A member of a maximum contributes its gradient if its value
        is at most ``within`` below the maximum.  The leading member comes first.
        """

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the value in terms of auxiliaries and equations at ``tree.q``; ``scale`` is a typical value."""


class WorstCase(Minimized, Protocol):
    """The largest value that an uncertain impact can have at one posture.

    The parameters of :meth:`lift` are the normal.
    """

    @property
    def oracle(self) -> ImpactOracle:
        """The oracle of the leading contact, on the robot as modeled."""

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and tangent gradient (nv) of the worst member in the symbols of a kernel of its contact."""


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
        """Text that identifies the expressions of a robot, as part of the key of the compile cache."""

    @property
    def parameters(self) -> Array:
        """Parameters of the lifted form, which may change without rebuilding the program, shape (k,)."""

    def movable(self, q: Array) -> bool:
        """Return whether the contact can move at ``q``; otherwise the value is a rounding error."""

    def blind_motions(self) -> Array:
        """Return base twists that do not change the value, world axes, linear first, shape (k, 6)."""
