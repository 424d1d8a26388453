"""One impact along one normal: no maximum but ``λ = λ̄``."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.impact_kind import ImpactKind
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import Guess, Lifted
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.impact.worst_case import Subgradients

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class SingleImpact:
    """The kind's own value at the contact's normal.

    Attributes:
        oracle: Pinocchio's numbers.
        kind: What is minimized.
        attempts: Guesses of the lifted form.
    """

    oracle: ImpactOracle
    kind: ImpactKind
    attempts: int = 1

    def value(self, q: Vector) -> float:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return self.kind.value(self.oracle, q)

    def gradient(self, q: Vector) -> Vector:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return self.kind.gradient(self.oracle, q)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return Subgradients(self.gradient(q)[None, :], np.zeros(1))

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return self.kind.expressions(k)

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return self.kind.lift(self.oracle.case, tree, n)

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        values = self.kind.guess(self.oracle, q)
        return Guess(values, np.full(values.size, -np.inf))
