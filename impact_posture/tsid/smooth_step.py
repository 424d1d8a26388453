"""Cubic smooth step for activation levels and fades."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", float, NDArray[np.float64])


def smooth(x: _Number) -> _Number:
    """Return ``3x² − 2x³``, which increases from 0 to 1 on [0, 1].  The slope is 0 at both ends and at most 1.5."""
    return x * x * (3.0 - 2.0 * x)
