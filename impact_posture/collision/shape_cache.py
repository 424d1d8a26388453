"""Fitted shapes in the cache of the user."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar

from pydantic import Field

from impact_posture.collision.swept_hull import MOST_VERTICES
from impact_posture.stored_text import read_stored, write_stored
from impact_posture.tables import STRICT

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Index = Annotated[int, Field(ge=0)]
_Names = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class StoredHull:
    """A :class:`~impact_posture.collision.swept_hull.SweptHull` as it is stored."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    link: str
    joint: _Index
    vertices: Annotated[tuple[tuple[_Number, _Number, _Number], ...], Field(min_length=1, max_length=MOST_VERTICES)]
    radius: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    faces: tuple[tuple[_Index, _Index, _Index], ...]

    @property
    def whole(self) -> bool:
        """Whether all faces join vertices."""
        return all(k < len(self.vertices) for face in self.faces for k in face)


@dataclass(frozen=True)
class StoredShapes:
    """A :class:`~impact_posture.collision.shapes.RobotShapes` as it is stored."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    bodies: tuple[StoredHull, ...]
    pairs: tuple[tuple[_Index, _Index], ...]
    always_touching: _Names
    hulls_touching: _Names
    warnings: tuple[str, ...]


def read_shapes(key: str, joints: int) -> StoredShapes | None:
    """Return the stored shapes of a key, for a model of so many joints; ``None`` where no file can be used."""
    text = read_stored("shapes", key)
    # A pydantic fault is a ValueError.
    with suppress(ValueError):
        stored: StoredShapes | None = None if text is None else _adapter().validate_json(text)
        if (
            stored
            and all(hull.joint < joints and hull.whole for hull in stored.bodies)
            and all(k < len(stored.bodies) for pair in stored.pairs for k in pair)
        ):
            return stored
    return None


def write_shapes(key: str, shapes: StoredShapes) -> None:
    """Store the shapes of a key, if the cache can be written."""
    write_stored("shapes", key, _adapter().dump_json(shapes).decode())


@cache
def _adapter() -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(StoredShapes)
