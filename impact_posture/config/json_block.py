"""Dataclasses that are blocks of a JSON document."""

from __future__ import annotations

from dataclasses import fields
from math import isfinite
from typing import Any, ClassVar, cast


class JsonBlock:
    """A dataclass that is a block of a JSON document.

    Attributes:
        derived: Names of properties that the block contains in addition to its fields.
    """

    derived: ClassVar[tuple[str, ...]] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return JSON content: arrays as lists, ``None`` for a number that is not finite, and nested blocks."""
        names = [field.name for field in fields(cast("Any", self))]
        return {name: _json(getattr(self, name)) for name in (*names, *self.derived)}


def _json(entry: Any) -> Any:
    if isinstance(entry, tuple | list):
        return [_json(part) for part in entry]
    if isinstance(entry, dict):
        return {key: _json(value) for key, value in entry.items()}
    if hasattr(entry, "to_dict"):
        return entry.to_dict()
    if hasattr(entry, "tolist"):
        return _json(entry.tolist())
    return None if isinstance(entry, float) and not isfinite(entry) else entry
