"""JSON content of dataclasses."""

from __future__ import annotations

from dataclasses import fields
from typing import Any


def json_block(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON content: arrays as lists, nested objects by their ``to_dict``."""
    return {field.name: _json(getattr(value, field.name)) for field in fields(value)}


def _json(entry: Any) -> Any:
    if isinstance(entry, tuple):
        return [_json(part) for part in entry]
    if hasattr(entry, "to_dict"):
        return entry.to_dict()
    return entry.tolist() if hasattr(entry, "tolist") else entry
