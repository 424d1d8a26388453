"""Numbers and poses as MJCF writes them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin


def numbers(values: Iterable[float]) -> str:
    """Numbers with every digit that a double has."""
    return " ".join(repr(float(v)) for v in values)


def pose(placement: pin.SE3, *, always: bool = False) -> dict[str, str]:
    """``pos`` and ``quat`` (w x y z); nothing for the identity unless asked."""
    found = {}
    if always or np.any(placement.translation):
        found["pos"] = numbers(placement.translation)
    if always or not np.array_equal(placement.rotation, np.eye(3)):
        quaternion = pin.Quaternion(np.array(placement.rotation)).normalized()
        found["quat"] = numbers((quaternion.w, quaternion.x, quaternion.y, quaternion.z))
    return found
