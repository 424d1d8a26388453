"""Directions in which the reference flow measures the curvature beside its posture."""

from __future__ import annotations

import math

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy

# Least square of the length of a direction.
_EMPTY = 1e-24
# A direction with a shorter new part is orthogonalized once more, because rounding would leave it inexact.
_NEW = 0.1


class ProbeDirections:
    """Unit vectors on the constraints, orthogonal to each other in a round over all directions that are left.

    They are projections of fixed directions, because the columns of the basis ``Z`` are not unique.  The fixed
    directions leave out no entry and are the same, bit for bit, on every machine: the fractions of ``k² φ``, with the
    golden ratio φ in 32 bits, are spread like random numbers.

    Attributes:
        count: Number of directions in which the flow has measured.
    """

    def __init__(self, nv: int) -> None:
        k = np.arange(1, nv * nv + 1, dtype=np.uint32)
        self._fixed = (k * k * np.uint32(2654435769) / 2.0**32 - 0.5).reshape(nv, nv)
        self._seen = np.zeros((nv, nv))
        self.count = 0

    def next(self, space: Redundancy) -> Array:
        """Return the part of the next fixed direction that is orthogonal to the round's earlier ones, shape (nv,)."""
        k = self.count % space.basis.shape[1]
        z, seen = self._seen[k], self._seen[:k]
        z[:] = self._fixed[k]
        for _ in range(2):
            z[:] = space.project(z - (seen @ z) @ seen)
            length = math.sqrt(max(float(z @ z), _EMPTY))
            z /= length
            if length > _NEW:
                break
        return np.asarray(z)
