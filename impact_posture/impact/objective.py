"""The :class:`Objective` protocol, and the protocols of its parts.

The program, its starts, the solver and the certificate know nothing but :class:`Objective`.
"""

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
    """Points whose convex hull is a subdifferential, up to their gaps.

    Attributes:
        gradients: Tangent gradients, shape (k, nv).
        gaps: Distance of the value of each member below the objective, shape (k,).
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
        """Number of guesses from which the lifted form may be tried."""
        ...

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        """Return the initial auxiliaries of the lifted form at ``q``, and their bounds."""
        ...

    def value(self, q: Array) -> float:
        """Return the value from Pinocchio's numbers, > 0.

        Raises:
            MetricError: The value does not exist at ``q``.
        """
        ...

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        """Return vectors that span the subdifferential at ``q``, from Pinocchio's numbers.

        There is one gradient where the value is smooth.  Members of a maximum count if they are at most ``within``
        below it, the leading member first.
        """
        ...

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        """Return the value in terms of auxiliaries and equations at ``tree.q``; ``scale`` is a typical value."""
        ...


class WorstCase(Minimized, Protocol):
    """The largest value that the impact may have at one posture; the parameters of ``lift`` are the normal."""

    @property
    def oracle(self) -> ImpactOracle:
        """Pinocchio's numbers for the leading contact, on the robot as modeled."""
        ...

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Return value and tangent gradient (nv) in the symbols of a kernel of the objective's robot and contact."""
        ...


class Objective(Minimized, Protocol):
    """The function that a posture problem minimizes, with the contacts and supports that the problem holds."""

    @property
    def robot(self) -> Robot:
        """The robot."""
        ...

    @property
    def name(self) -> str:
        """Name in outputs."""
        ...

    @property
    def contacts(self) -> tuple[ImpactContact, ...]:
        """Contacts whose frames the problem holds; empty for none."""
        ...

    @property
    def supports(self) -> tuple[Support, ...]:
        """Feet that the problem holds; empty for none."""
        ...

    @property
    def structure(self) -> str:
        """Text that determines its expressions besides the robot's dynamics; part of the compile cache's key."""
        ...

    @property
    def parameters(self) -> Array:
        """Numbers of the lifted form that may change without rebuilding the program, shape (k,)."""
        ...

    def movable(self, q: Array) -> bool:
        """Return whether the value at ``q`` is more than rounding."""
        ...

    def blind_motions(self) -> Array:
        """Return base twists that do not change the value, world axes, linear first, shape (k, 6)."""
        ...
