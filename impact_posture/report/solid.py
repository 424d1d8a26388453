"""Small triangle meshes, and how they are kept in the cache of the user."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pinocchio as pin
from pydantic import PlainSerializer, PlainValidator

from impact_posture.arrays import Array
from impact_posture.stored_text import StoredArray

_Placement = Annotated[
    pin.SE3,
    PlainValidator(lambda rows: pin.SE3(np.array(rows))),
    PlainSerializer(lambda at: at.homogeneous.tolist()),
]


@dataclass(frozen=True, eq=False)
class Solid:
    """A triangle mesh with whole coordinates.

    Attributes:
        corners: Corners as multiples of ``step`` from ``low``, shape (k, 3).
        faces: Triangles as indices, shape (n, 3).
        low: Least coordinates, m, shape (3,).
        step: Length of a unit, m.
    """

    corners: StoredArray
    faces: StoredArray
    low: StoredArray
    step: float

    @property
    def points(self) -> Array:
        """Corners, m, shape (k, 3)."""
        return self.low + self.step * self.corners


@dataclass(frozen=True, eq=False)
class PlacedSolids:
    """Meshes, and where they are.

    Attributes:
        solids: The meshes.
        places: Name of a shape, joint, index of its mesh, and placement in the axes of the joint.
        warnings: Shapes that are left out, one line each.
    """

    solids: tuple[Solid, ...]
    places: tuple[tuple[str, int, int, _Placement], ...]
    warnings: tuple[str, ...]
