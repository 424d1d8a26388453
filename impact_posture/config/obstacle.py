"""An obstacle as a setting; :mod:`impact_posture.collision.swept_hull` makes its shape."""

from __future__ import annotations

import math
from dataclasses import dataclass

from impact_posture.config import demands as demand
from impact_posture.config.demands import setting, with_demands
from impact_posture.config.toml_tables import Checked
from impact_posture.errors import InputError

# Most characters of the name of an obstacle, which errors print.
_LONGEST_NAME = 60


@dataclass(frozen=True, kw_only=True)
@with_demands
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
    box: tuple[float, float, float] | None = setting(None, "Edge lengths, m.", **demand.LENGTHS)
    sphere: float | None = setting(None, "Radius, m.", **demand.ABOVE_ZERO)
    position: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "Center in the world, m.", **demand.NUMBERS)
    quaternion: tuple[float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 1.0), "Orientation x y z w.", **demand.NUMBERS
    )

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if not self.name.strip() or len(self.name) > _LONGEST_NAME:
            what = "has no name" if not self.name.strip() else f"has a name of {len(self.name)} characters"
            raise InputError(what, where="obstacles", hint=f"give each a name of up to {_LONGEST_NAME} characters")
        where = f"obstacle '{self.name}'"
        if (self.box is None) == (self.sphere is None):
            what = "neither edge lengths nor a radius" if self.box is None else "edge lengths and a radius"
            raise InputError(f"has {what}", where=where, hint="give one of the keys box and sphere")
        norm = math.hypot(*self.quaternion)
        if abs(norm - 1) > 1e-3:
            raise InputError(
                f"the quaternion has norm {norm:.4g}", where=where, hint="give a unit quaternion x y z w"
            )
