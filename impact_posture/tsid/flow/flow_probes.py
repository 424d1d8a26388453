"""Directions along which the reference flow measures the curvature near its posture."""

from __future__ import annotations

import math

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy

# Least squared length of a direction, which prevents a division by zero.
_EMPTY = 1e-24
# A direction that is shorter than this after the orthogonalization is orthogonalized again, because its rounding
# errors are large.
NEW = 0.1


class ProbeDirections:
    """Unit vectors in the r-dimensional null space of the constraints.  Each round of r vectors is orthogonal.

    The vectors are projections of fixed directions, because the columns of the basis ``Z`` are not unique.  The
    entries of the fixed directions are the fractional parts of ``k² φ`` minus 1/2, where φ is the golden ratio in 32
    bits.  Such entries are spread like random numbers and are equal, bit for bit, on every machine.

    Attributes:
        count: Number of directions in which the flow has measured.
    """

    def __init__(self, nv: int) -> None:
        k = np.arange(1, nv * nv + 1, dtype=np.uint32)
        self._fixed = (k * k * np.uint32(2654435769) / 2.0**32 - 0.5).reshape(nv, nv)
        self._seen = np.zeros((nv, nv))
        self.count = 0

    def next(self, space: Redundancy) -> Array:
        """Return the next unit vector, shape (nv,), which is orthogonal to the earlier vectors of its round."""
        k = self.count % space.basis.shape[1]
        z, seen = self._seen[k], self._seen[:k]
        z[:] = self._fixed[k]
        for _ in range(2):
            z[:] = space.project(z - (seen @ z) @ seen)
            length = math.sqrt(max(float(z @ z), _EMPTY))
            z /= length
            if length > NEW:
                break
        return np.asarray(z)
