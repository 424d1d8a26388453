"""Obstacles in the world: boxes and balls."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Annotated

import numpy as np
import pinocchio as pin

from impact_posture import setting as demand
from impact_posture.collision.swept_hull import SweptHull
from impact_posture.errors import InputError
from impact_posture.setting import Setting
from impact_posture.settings import Vector3
from impact_posture.tables import Checked

Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Obstacle(Checked):
    """A box or a ball that the robot stays clear of.

    Attributes:
        name: Name in messages.
        box: Edge lengths of a box along its own axes, m.
        sphere: Radius of a ball, m.
        position: Center in the world, m.
        quaternion: Orientation of a box in the world, x y z w.

    Raises:
        InputError: A value does not fit, there is not exactly one of ``box`` and ``sphere``, or the quaternion has no
            unit length.
    """

    name: str
    box: Annotated[Vector3 | None, Setting("Edge lengths, m.", **demand.LENGTHS)] = None
    sphere: Annotated[float | None, Setting("Radius, m.", **demand.ABOVE_ZERO)] = None
    position: Annotated[Vector3, Setting("Center in the world, m.", **demand.NUMBERS)] = (0.0, 0.0, 0.0)
    quaternion: Annotated[Quaternion, Setting("Orientation x y z w.", **demand.NUMBERS)] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        where = f"obstacle '{self.name}'"
        if (self.box is None) == (self.sphere is None):
            what = "neither `box` nor `sphere`" if self.box is None else "both `box` and `sphere`"
            raise InputError(f"has {what}", where=where, hint="give one of them")
        norm = float(np.linalg.norm(self.quaternion))
        if abs(norm - 1) > 1e-3:
            raise InputError(
                f"the quaternion has norm {norm:.4g}", where=where, hint="give a unit quaternion x y z w"
            )

    @property
    def hull(self) -> SweptHull:
        """The obstacle as a swept hull in the world."""
        center = np.array(self.position)
        if self.box is None:
            return SweptHull(self.name, self.name, 0, center[None], float(self.sphere or 0.0))
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * self.box
        x, y, z, w = np.array(self.quaternion) / np.linalg.norm(self.quaternion)
        return SweptHull(self.name, self.name, 0, center + corners @ pin.Quaternion(w, x, y, z).matrix().T, 0.0)
