"""Obstacle of a ``problem.toml``; :mod:`impact_posture.collision.swept_hull` builds its collision shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from impact_posture.config.checked import checked
from impact_posture.config.demand import Demand, Lengths, Position, Positive, UnitQuaternion
from impact_posture.config.table_validation import StrictTable
from impact_posture.errors import InputError

# Largest number of characters in the name of an obstacle, because error messages contain the name.
_LONGEST_NAME = 60
_Name = Annotated[
    str,
    Demand(
        lambda name: bool(name.strip()) and len(name) <= _LONGEST_NAME, f"a name of up to {_LONGEST_NAME} characters"
    ),
]


@checked
@dataclass(frozen=True, kw_only=True)
class Obstacle(StrictTable):
    """Box or ball that the robot must not touch.

    Attributes:
        name: Name of the obstacle in messages.
        box: Edge lengths of a box along its own axes, m.
        sphere: Radius of a ball, m.
        position: Center in the world, m.
        quaternion: Orientation of a box in the world, x y z w.

    Raises:
        InputError: A value is not valid, or ``box`` and ``sphere`` are both given or both missing.
    """

    name: _Name
    box: Lengths | None = None
    sphere: Positive | None = None
    position: Position = (0.0, 0.0, 0.0)
    quaternion: UnitQuaternion = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if (self.box is None) == (self.sphere is None):
            what = "neither edge lengths nor a radius" if self.box is None else "edge lengths and a radius"
            where = f"obstacle '{self.name}'"
            raise InputError(f"has {what}", where=where, hint="give one of the keys box and sphere")
