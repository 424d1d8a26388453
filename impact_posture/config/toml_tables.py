"""Reading of text and TOML files that a user names, and validation of tables against dataclasses."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, get_type_hints

from impact_posture.errors import InputError, SpecError, nearest, not_one_of, shown
from impact_posture.system.text_files import read_text

if TYPE_CHECKING:
    pass


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
    except ValueError as error:  # An integer with more digits than Python converts.
        raise SpecError(f"cannot be read ({error})", where=where, hint="correct the value") from None
    try:
        made: _Table = adapter(cls).validate_json(text)  # type: ignore[arg-type]
        return made
    except ValidationError as error:
        # A misspelt key is reported before the key that is then missing.
        faults = error.errors()
        fault = next((f for f in faults if f["type"] in _UNKNOWN), faults[0])
        location = tuple(part for part in fault["loc"] if not (isinstance(part, str) and "[" in part))
        path = ".".join(str(part) for part in location)
        if fault["type"] in _UNKNOWN:
            close = ", ".join(nearest(str(location[-1]), _keys_at(cls, location[:-1])))
            raise SpecError(f"unknown key '{shown(path)}'", where=where, hint=f"did you mean {close}?") from None
        what, hint = str(fault["msg"]), "correct the value"
        if fault["type"] == "value_error":
            # The demand of a setting is the hint.
            raise SpecError(
                f"key '{path}' is {shown(fault['input'])}", where=where, hint=str(fault["ctx"]["error"])
            ) from None
        if fault["type"] == "literal_error":
            what, hint = not_one_of(fault["input"], re.findall(r"'([^']*)'", fault["ctx"]["expected"]))
        raise SpecError(f"key '{path}': {what}", where=where, hint=hint) from None


def json_block(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON content: arrays as lists, and parts by their own ``to_dict``."""
    return {field.name: _json(getattr(value, field.name)) for field in fields(value)}


def _json(entry: Any) -> Any:
    if isinstance(entry, tuple):
        return [_json(part) for part in entry]
    if hasattr(entry, "to_dict"):
        return entry.to_dict()
    return entry.tolist() if hasattr(entry, "tolist") else entry


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")


@cache
def adapter(cls: type) -> Any:
    """Return the ``TypeAdapter`` of a dataclass, made once."""
    from pydantic import TypeAdapter

    return TypeAdapter(cls)


def _keys_at(cls: type, location: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at a location inside the table of ``cls``."""
    for part in location:
        hint = get_type_hints(cls).get(str(part))
        inner = [c for c in (hint, *getattr(hint, "__args__", ())) if isinstance(c, type) and is_dataclass(c)]
        cls = inner[0] if inner else cls
    return [field.name for field in fields(cls)]


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        SpecError: There is no such file, it cannot be read, or it is no valid TOML.
    """
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise SpecError("no such file", where=str(path), hint="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"cannot be read ({error})", where=str(path), hint="check the file") from None
    except RecursionError:
        raise SpecError("is nested too deeply", where=str(path), hint="correct the syntax") from None
    except ValueError as error:  # A TOMLDecodeError, or a number with more digits than Python converts.
        raise SpecError(f"is not valid TOML ({error})", where=str(path), hint="correct the syntax") from None


class Checked:
    """Base of a dataclass whose annotations say which values it takes, in a file and in Python."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    def __post_init__(self) -> None:
        """Check every value against its annotation.

        Raises:
            InputError: A value does not fit.
        """
        from pydantic import ValidationError

        for name, adapter in _field_adapters(type(self)).items():  # type: ignore[arg-type]
            try:
                adapter.validate_python(getattr(self, name))
            except ValidationError as error:
                # Of the alternatives of a union, the one that fits best fails deepest.
                fault = max(error.errors(), key=lambda fault: len(fault["loc"]))
                missing = fault["type"] == "missing"
                index = "".join(f"[{part}]" for part in fault["loc"] if isinstance(part, int) and not missing)
                given = fault["input"]
                quoted = repr(given) if isinstance(given, str) else shown(given)
                raise InputError(
                    f"{name}{index} is {quoted}",
                    where=type(self).__name__,
                    hint=fault["msg"].replace("Input should", "it should"),
                ) from None


@cache
def _field_adapters(cls: type) -> dict[str, Any]:
    from pydantic import TypeAdapter

    hints = get_type_hints(cls, include_extras=True)
    return {field.name: TypeAdapter(hints[field.name]) for field in fields(cls)}
