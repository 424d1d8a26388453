"""Small triangle meshes, and how they are kept in the cache of the user."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.arrays import Array
from impact_posture.collision.mesh_triangles import Triangles
from impact_posture.stored_text import read_stored, write_stored


@dataclass(frozen=True, eq=False)
class Solid:
    """A triangle mesh with whole coordinates.

    Attributes:
        corners: Corners as multiples of ``step`` from ``low``, shape (k, 3).
        faces: Triangles as indices, shape (n, 3).
        low: Least coordinates, m, shape (3,).
        step: Length of a unit, m.
    """

    corners: NDArray[np.uint16]
    faces: Triangles
    low: Array
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
    places: tuple[tuple[str, int, int, pin.SE3], ...]
    warnings: tuple[str, ...]

    def store(self, key: str) -> None:
        """Keep the meshes in the cache of the user, if it can be written."""
        content = {
            "solids": [
                [_packed(one.corners, "<u2"), _packed(one.faces, "<u4"), one.low.tolist(), one.step]
                for one in self.solids
            ],
            "places": [[*place, at.homogeneous.tolist()] for *place, at in self.places],
            "warnings": self.warnings,
        }
        write_stored("solids", key, json.dumps(content))

    @staticmethod
    def stored(key: str) -> PlacedSolids | None:
        """Return the meshes that were kept; ``None`` where no file can be used."""
        text = read_stored("solids", key)
        with suppress(ValueError, TypeError, LookupError):
            content: dict[str, Any] = json.loads(text or "")
            solids = tuple(
                Solid(_unpacked(corners, "<u2"), _unpacked(faces, "<u4").astype(int), np.array(low), step)
                for corners, faces, low, step in content["solids"]
            )
            places = tuple((name, joint, k, pin.SE3(np.array(at))) for name, joint, k, at in content["places"])
            return PlacedSolids(solids, places, tuple(content["warnings"]))
        return None


def _packed(rows: NDArray[Any], kind: str) -> str:
    return b64encode(rows.astype(kind).tobytes()).decode("ascii")


def _unpacked(text: str, kind: str) -> NDArray[Any]:
    return np.frombuffer(b64decode(text), kind).reshape(-1, 3)
