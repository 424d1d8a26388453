"""Directions in which the reference flow looks beside its posture."""

from __future__ import annotations

import math

import numpy as np

from impact_posture.system.arrays import Array
from impact_posture.tsid.flow.redundancy import Redundancy

# Square of the length below which a direction is none.
_EMPTY = 1e-24
# Length of what is new in a direction below which once more makes it exact.
_NEW = 0.1


class ProbeDirections:
    """Unit vectors on the constraints, orthogonal to each other in a round of as many as the constraints leave.

    The columns of the basis are as good as any others of that space.  What a fixed direction has in it is unique.

    Attributes:
        count: Number of directions in which the flow has looked.
    """

    def __init__(self, nv: int) -> None:
        """Size the buffers."""
        self._mixed, self._seen = mixed_directions(nv), np.zeros((nv, nv))
        self.count = 0

    def next(self, space: Redundancy) -> Array:
        """Return what is new in the next fixed direction, shape (nv,)."""
        k = self.count % space.basis.shape[1]
        z, seen = self._seen[k], self._seen[:k]
        z[:] = self._mixed[k]
        for _ in range(2):
            z[:] = space.project(z - (seen @ z) @ seen)
            length = math.sqrt(max(float(z @ z), _EMPTY))
            z /= length
            if length > _NEW:
                break
        return np.asarray(z)


def mixed_directions(nv: int) -> Array:
    """Return directions in which no entry is left out, shape (nv, nv), bit for bit the same on every machine.

    The fractions of ``k² φ``, φ the golden ratio in 32 bits, are spread like random numbers.
    """
    k = np.arange(1, nv * nv + 1, dtype=np.uint32)
    return np.asarray((k * k * np.uint32(2654435769) / 2.0**32 - 0.5).reshape(nv, nv))
