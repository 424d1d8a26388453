"""A model that is not known well: the worst over a few named variants of it.

``min_q max_k f_k(q)``, ``f_k`` the objective on the k-th model: in the program ``min t`` with ``t ≥ f_k(q)``.  It is
the worst of the variants and of nothing between them: :mod:`impact_posture.posture.robustness` samples what lies
there.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.kernel import ImpactKernel
from impact_posture.impact.lifted import ABOVE, Guess, Lifted, worst_of, worst_of_guesses
from impact_posture.impact.oracle import ImpactOracle
from impact_posture.impact.worst_case import Subgradients, WorstCase, finite_maximum, first_of_largest

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class ModelSet:
    """The worst of the same worst case on several models.

    Attributes:
        members: That on each model, the robot as modeled first.
    """

    members: tuple[WorstCase, ...]

    @property
    def oracle(self) -> ImpactOracle:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return self.members[0].oracle

    @property
    def attempts(self) -> int:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return max(len(ABOVE), *[member.attempts for member in self.members])

    def values(self, q: Vector) -> Vector:
        """The value on each model, from Pinocchio's numbers, shape (k,)."""
        return np.array([member.value(q) for member in self.members])

    def worst(self, q: Vector) -> int:
        """Number of the worst model."""
        return finite_maximum(self.values(q))[0]

    def value(self, q: Vector) -> float:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return float(self.values(q).max())

    def gradient(self, q: Vector) -> Vector:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        return self.members[self.worst(q)].gradient(q)

    def subgradients(self, q: Vector, within: float = 0.0) -> Subgradients:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`; of all models that tie."""
        _, tied, gaps = finite_maximum(self.values(q), within)
        # What a model lies below the worst one is no longer there for its own members.
        parts = [self.members[k].subgradients(q, max(within - gap, 0.0)) for k, gap in zip(tied, gaps, strict=True)]
        return Subgradients(
            np.vstack([part.gradients for part in parts]),
            np.concatenate([part.gaps + gap for part, gap in zip(parts, gaps, strict=True)]),
        )

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`: every model's, and the worst one's gradient."""
        pairs = []
        for member in self.members:
            # Repeated limbs are alike in the model as it stands.  A payload makes them differ.
            case = member.oracle.case
            pairs.append(member.expressions(k if case.robot is k.case.robot else ImpactKernel(case, k.q, k.n)))
        return first_of_largest([value for value, _ in pairs], [gradient for _, gradient in pairs])

    def lift(self, tree: Tree, n: ca.SX, scale: ca.SX) -> Lifted:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`: each model's own, ``t`` above all."""
        parts = []
        for member in self.members:
            model = member.oracle.robot.model
            parts.append(member.lift(tree if model is tree.model else Tree(model, tree.q), n, scale))
        return worst_of(parts, [part.value for part in parts], scale)

    def guess(self, q: Vector, scale: float, attempt: int = 0) -> Guess:
        """See :class:`~impact_posture.impact.worst_case.WorstCase`."""
        parts = [member.guess(q, scale, min(attempt, member.attempts - 1)) for member in self.members]
        return worst_of_guesses(parts, self.value(q) / scale, attempt)
