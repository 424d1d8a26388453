"""Reading of tables from TOML files or options, and their validation against dataclasses."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from impact_posture.errors import SpecError, nearest, not_one_of

_Table = TypeVar("_Table")

STRICT = {"extra": "forbid", "strict": True}
"""``__pydantic_config__`` of a dataclass that refuses unknown keys, numbers in quotes, and ``true`` for 1."""


def validate(cls: type[_Table], data: object, where: str) -> _Table:
    """Make a dataclass of a table; the first fault becomes one line with the nearest valid key.

    Args:
        cls: Dataclass, whose fields may be dataclasses; its ``__pydantic_config__`` defines how strict it is.
        data: Table from :func:`read_toml`; the key ``schema`` fills a field ``schema_``.
        where: File to name in errors.

    Raises:
        SpecError: A key is unknown or missing, or a value does not fit.
    """
    from pydantic import ValidationError

    try:
        # As JSON, because strict dataclasses do not accept Python dictionaries.
        text = json.dumps(data, default=_plain)
        made: _Table = _adapter(cls).validate_json(text)  # type: ignore[arg-type]
        return made
    except ValidationError as error:
        # A misspelt key is reported before the key that is then missing.
        faults = error.errors()
        fault = next((f for f in faults if f["type"] in _UNKNOWN), faults[0])
        location = tuple(part for part in fault["loc"] if not (isinstance(part, str) and "[" in part))
        path = ".".join(str(part) for part in location)
        if fault["type"] in _UNKNOWN:
            close = ", ".join(nearest(str(location[-1]), _keys_at(cls, location[:-1])))
            raise SpecError(f"unknown key '{path}'", where=where, hint=f"did you mean {close}?") from None
        what, hint = str(fault["msg"]), "correct the value"
        if fault["type"] == "value_error":
            # The demand of a setting is the hint.
            raise SpecError(
                f"key '{path}' is {fault['input']}", where=where, hint=str(fault["ctx"]["error"])
            ) from None
        if fault["type"] == "literal_error":
            what, hint = not_one_of(fault["input"], re.findall(r"'([^']*)'", fault["ctx"]["expected"]))
        raise SpecError(f"key '{path}': {what}", where=where, hint=hint) from None


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")


@cache
def _adapter(cls: type) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(cls)


def _keys_at(cls: type, location: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at a location inside the table of ``cls``."""
    for part in location:
        hint = get_type_hints(cls).get(str(part))
        inner = [
            c for c in (hint, *getattr(hint, "__args__", ())) if isinstance(c, type) and hasattr(c, "__annotations__")
        ]
        cls = inner[0] if inner else cls
    if not is_dataclass(cls):
        return [name.rstrip("_") for name in cls.model_fields]  # type: ignore[attr-defined]
    return [field.name for field in fields(cls)]


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        SpecError: There is no such file, it cannot be read, or it is no valid TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SpecError("no such file", where=str(path), hint="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"cannot be read ({error})", where=str(path), hint="check the file") from None
    except RecursionError:
        raise SpecError("is nested too deeply", where=str(path), hint="correct the syntax") from None
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"is not valid TOML ({error})", where=str(path), hint="correct the syntax") from None
