"""JSON content of Python values, and dataclasses that are blocks of a JSON document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from math import isfinite
from typing import Any, ClassVar


class JsonBlock:
    """A dataclass that is a block of a JSON document.

    Attributes:
        derived: Names of properties that the block contains in addition to its fields.
    """

    derived: ClassVar[tuple[str, ...]] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return JSON content, as in :func:`jsonable`."""
        return _fields(self) | {name: jsonable(getattr(self, name)) for name in self.derived}


def jsonable(content: Any) -> Any:
    """Convert content to JSON: dataclasses to objects, arrays to lists, and non-finite numbers to ``None``."""
    if hasattr(content, "to_dict"):
        return content.to_dict()
    if is_dataclass(content):
        return _fields(content)
    if isinstance(content, Mapping):
        return {key: jsonable(value) for key, value in content.items()}
    if isinstance(content, tuple | list):
        return [jsonable(part) for part in content]
    if hasattr(content, "tolist"):
        return jsonable(content.tolist())
    return None if isinstance(content, float) and not isfinite(content) else content


def _fields(value: Any) -> dict[str, Any]:
    return {field.name: jsonable(getattr(value, field.name)) for field in fields(value)}
