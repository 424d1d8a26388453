"""The worst case over several robot models, and the maximum of finitely many values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impact_posture.dynamics.tree import Tree
from impact_posture.impact.objective import Subgradients, WorstCase
from impact_posture.impact.quantities.impact_kernel import ImpactKernel
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.quantities.lifted_form import ABOVE, Guess, Lifted, worst_of, worst_of_guesses
from impact_posture.system.arrays import Array

# A value is treated as equal to the largest value if it is at most this fraction smaller.
ACTIVE = 1e-6


@dataclass(frozen=True)
class ModelSet:
    """The largest objective over several robot models.

    With the objective ``f_k`` of the k-th model, the problem ``min_q max_k f_k(q)`` becomes ``min t`` with
    ``t ≥ f_k(q)`` for all k.  Models between the variants are not included;
    :mod:`impact_posture.posture.analysis.robustness` samples them.  ``members`` contains the worst case for each
    model, the nominal model first.
    """

    members: tuple[WorstCase, ...]

    @property
    def oracle(self) -> ImpactOracle:
        return self.members[0].oracle

    @property
    def attempts(self) -> int:
        return max(len(ABOVE), *[member.attempts for member in self.members])

    def values(self, q: Array) -> Array:
        """Return the objective for each model, computed with Pinocchio, shape (k,)."""
        return np.array([member.value(q) for member in self.members])

    def value(self, q: Array) -> float:
        return float(self.values(q).max())

    def subgradients(self, q: Array, within: float = 0.0) -> Subgradients:
        tied, gaps = finite_maximum(self.values(q), within)
        # The value of model k is ``gap`` below the maximum, so its subgradients may be ``within − gap`` below this
        # value.
        parts = [self.members[k].subgradients(q, max(within - gap, 0.0)) for k, gap in zip(tied, gaps, strict=True)]
        return Subgradients(
            np.vstack([part.gradients for part in parts]),
            np.concatenate([part.gaps + gap for part, gap in zip(parts, gaps, strict=True)]),
        )

    def expressions(self, k: ImpactKernel) -> tuple[ca.SX, ca.SX]:
        pairs = []
        for member in self.members:
            # A model with a payload on one limb has other repeated limbs, so it needs its own kernel.
            case = member.oracle.case
            same = case.robot is k.case.robot
            pairs.append(member.expressions(k if same else ImpactKernel(case, k.q, k.n, visits=k.tree.visits)))
        return first_of_largest([value for value, _ in pairs], [gradient for _, gradient in pairs])

    def lift(self, tree: Tree, parameters: ca.SX, scale: ca.SX) -> Lifted:
        parts = []
        for member in self.members:
            model = member.oracle.robot.model
            parts.append(member.lift(tree if model is tree.model else Tree(model, tree.q), parameters, scale))
        return worst_of(parts, [part.value for part in parts], scale)

    def guess(self, q: Array, scale: float, attempt: int = 0) -> Guess:
        parts = [member.guess(q, scale, min(attempt, member.attempts - 1)) for member in self.members]
        return worst_of_guesses(parts, self.value(q) / scale, attempt)


def finite_maximum(values: Array, within: float = 0.0) -> tuple[NDArray[np.int_], Array]:
    """Return the indices of values near the maximum, and how far each of these values is below the maximum.

    A value is included if it is at most ``within``, or the fraction :data:`ACTIVE`, below the largest value.  The
    index of the largest value comes first.
    """
    largest = float(values.max())
    near = np.flatnonzero(values >= largest - max(ACTIVE * abs(largest), within))
    # Rounding errors must not determine the order, so values that differ only by rounding count as equal here.
    leading = int(np.flatnonzero(values >= largest - 1e-12 * abs(largest))[0])
    order = np.concatenate([[leading], near[near != leading]])
    return order, np.asarray(largest - values[order])


def first_of_largest(values: Sequence[ca.SX], choices: Sequence[ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Return the first largest entry of ``values``, and the entry of ``choices`` with the same index."""
    largest, choice = values[0], choices[0]
    for value, other in zip(values[1:], choices[1:], strict=True):
        larger = value > largest
        largest = ca.if_else(larger, value, largest)
        choice = choice + larger * (other - choice)
    return largest, choice
