"""Fitted shapes in the cache of the user.  A file that is damaged, or that another user may write, is not used."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from impact_posture.collision.swept_hull import MOST_VERTICES
from impact_posture.errors import OutputError
from impact_posture.libraries import cache_folder, check_private
from impact_posture.output_folder import write_whole
from impact_posture.tables import STRICT

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Names = tuple[tuple[str, str], ...]
# The largest file read, bytes.  The largest robot of the catalogue needs a hundredth of it.
_LARGEST = 10_000_000


@dataclass(frozen=True)
class StoredHull:
    """A :class:`~impact_posture.collision.swept_hull.SweptHull` as it is stored."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    link: str
    joint: Annotated[int, Field(ge=0)]
    vertices: Annotated[tuple[tuple[_Number, _Number, _Number], ...], Field(min_length=1, max_length=MOST_VERTICES)]
    radius: Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True)
class StoredShapes:
    """A :class:`~impact_posture.collision.shapes.RobotShapes` as it is stored."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    bodies: tuple[StoredHull, ...]
    pairs: tuple[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], ...]
    always_touching: _Names
    hulls_touching: _Names
    warnings: tuple[str, ...]


def read_shapes(key: str, joints: int) -> StoredShapes | None:
    """Return the stored shapes of a key, for a model of so many joints; ``None`` where no file can be used."""
    with suppress(OSError, OutputError, ValueError):
        path = _path(key)
        check_private(path)
        if path.stat().st_size > _LARGEST:
            return None
        seal, text = path.read_text(encoding="utf-8").split("\n", 1)
        if seal != _seal(text):
            return None
        # A pydantic fault is a ValueError.
        stored: StoredShapes = _adapter().validate_json(text)
        indices = [index for pair in stored.pairs for index in pair]
        if all(hull.joint < joints for hull in stored.bodies) and all(k < len(stored.bodies) for k in indices):
            return stored
    return None


def write_shapes(key: str, shapes: StoredShapes) -> None:
    """Store the shapes of a key, if the cache can be written."""
    text = _adapter().dump_json(shapes).decode()
    with suppress(OSError, OutputError):
        write_whole(_path(key), f"{_seal(text)}\n{text}")


def _path(key: str) -> Path:
    return cache_folder("shapes") / f"{key}.json"


def _seal(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def _adapter() -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(StoredShapes)
