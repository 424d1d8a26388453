"""The cubic step along which levels and fades move."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", float, NDArray[np.float64])


def smooth(x: _Number) -> _Number:
    """Return ``3x² − 2x³``, which goes from 0 at 0 to 1 at 1 with level ends and a slope of at most 1.5."""
    return x * x * (3.0 - 2.0 * x)
