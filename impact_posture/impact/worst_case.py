"""The inner maximum of ``min_q max ‖Δν‖²``: over normals, impulses, models, or over nothing at all.

Each shape of the maximum has its own exact form.  All stand behind one protocol, so that the program, the C export
and the certificate do not tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.oracle import ImpactOracle

Vector = NDArray[np.float64]

# Of a finite maximum, members whose value is within this share of the largest take part in its subdifferential.
ACTIVE = 1e-6


@dataclass(frozen=True, eq=False)
class Subgradients:
    """Points whose convex hull is a subdifferential, up to their gaps.

    Attributes:
        gradients: Tangent gradients, shape (k, nv).
        gaps: How far below the objective each one's own value is, shape (k,).
    """

    gradients: Vector
    gaps: Vector

    @property
    def first(self) -> Vector:
        """One of them, a subgradient, shape (nv,)."""
        return np.asarray(self.gradients[0])


class WorstCase(Protocol):
    """The largest value that the impact may have at one posture."""

    @property
    def oracle(self) -> ImpactOracle:
        """Pinocchio's numbers for the leading contact, on the robot as modeled."""
        ...

    @property
    def attempts(self) -> int:
        """From how many guesses the lifted form may be tried."""
        ...

    def value(self, q: Vector) -> float:
        """The maximum from Pinocchio's numbers.

        Raises:
            MetricError: It does not exist at ``q``.
        """
        ...

    def gradient(self, q: Vector) -> Vector:
        """Its tangent gradient, shape (nv,); where the maximum is tied, that of one of them."""
        ...

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """What spans its subdifferential; members at most ``within`` below the maximum count as well."""
        ...

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """Value and tangent gradient (nv) in the symbols of a kernel of the objective's robot and contact."""
        ...

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """The maximum with its linear solves as unknowns of a program, at ``tree.q``."""
        ...

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """Where the unknowns of :meth:`lift` start at ``q``."""
        ...


def finite_maximum(values: Vector, within: float = 0.0) -> tuple[int, NDArray[np.int_], Vector]:
    """Of finitely many values the first of the largest, all that tie with it (that one first), and their gaps.

    What ties is at most a share :data:`ACTIVE` below, or ``within``.
    """
    largest = float(values.max())
    near = np.flatnonzero(values >= largest - max(ACTIVE * abs(largest), within))
    # The named one must not hang on rounding: the first of those that differ by rounding alone.
    leading = int(np.flatnonzero(values >= largest - 1e-12 * abs(largest))[0])
    order = np.concatenate([[leading], near[near != leading]])
    return leading, order, np.asarray(largest - values[order])


def first_of_largest(values: list[ca.SX], choices: list[ca.SX]) -> tuple[ca.SX, ca.SX]:
    """The largest of expressions and what belongs to it, the first where they tie."""
    best, choice = values[0], choices[0]
    for value, other in zip(values[1:], choices[1:], strict=True):
        larger = value > best
        best = ca.if_else(larger, value, best)
        choice = choice + larger * (other - choice)
    return best, choice
