"""Read TOML files, and check whether their tables fit dataclasses, with suggestions for misspelt keys."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_type_hints

from impact_posture.errors import SpecError, nearest, not_one_of, shown
from impact_posture.system.text_files import read_text

_Table = TypeVar("_Table")


# A line that is YAML and cannot be TOML: ``key: value`` or ``- item``.
_YAML_LINE = re.compile(r"^ *(?:- )?[\w-]+:(?: |$)|^ *- ", re.MULTILINE)


class StrictTable:
    """Base of dataclasses that reject unknown keys, numbers in quotes, and ``true`` in place of 1 in a file."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True}


def validate(cls: type[_Table], data: object, where: str) -> _Table:
    """Convert a table to a dataclass.  If the table does not fit, the error describes the first fault in one line.

    Args:
        cls: Dataclass, possibly with nested dataclasses.  The ``__pydantic_config__`` of the dataclass may forbid
            unknown keys.
        data: Table, for example from :func:`read_toml`.
        where: Name of the file, for error messages.

    Raises:
        SpecError: A key is unknown or missing, or a value is not valid.
    """
    from pydantic import ValidationError

    try:
        # Pass the table as JSON, because strict dataclasses do not accept Python dictionaries.
        text = json.dumps(data, default=_plain, ensure_ascii=False)
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        before, after = text[: error.start].rpartition('"')[2], text[error.start :].partition('"')[0]
        hint = "rename the file or folder"
        raise SpecError(f"'{shown(before + after)}' is not UTF-8", where=where, hint=hint) from None
    except ValueError as error:  # An integer has more digits than Python converts.
        raise SpecError(f"cannot be read ({error})", where=where, hint="correct the value") from None
    try:
        table: _Table = adapter(cls).validate_json(text)  # type: ignore[arg-type]
        return table
    except ValidationError as error:
        # Report a misspelt key first, because the correctly spelt key is reported as missing, too.
        faults = error.errors()
        fault = next((f for f in faults if f["type"] in _UNKNOWN), faults[0])
    # Pydantic adds the type of the union member to the location.  Leave this type out.
    location = tuple(p for p in fault["loc"] if not (isinstance(p, str) and ("[" in p or p in ("str", "float"))))
    path = ".".join(str(part) for part in location)
    what, hint = f"key '{path}': {fault['msg']}", "correct the value"
    if fault["type"] in _UNKNOWN:
        close = ", ".join(nearest(str(location[-1]), _keys_at(cls, location[:-1])))
        what, hint = f"unknown key '{shown(path)}'", f"did you mean {close}?"
    elif fault["type"] == "missing":
        what, hint = f"key '{path}' is missing", "add it"
    elif fault["type"] == "value_error":  # from a Demand
        what, hint = f"key '{path}' is {shown(fault['input'])}", str(fault["ctx"]["error"])
    elif fault["type"] == "literal_error":
        # Pydantic writes "'a', 'b' or 3".
        choices = re.findall(r"'([^']*)'|(-?\d+)", fault["ctx"]["expected"])
        what, hint = not_one_of(fault["input"], [text or number for text, number in choices])
        what = f"key '{path}': {what}"
    raise SpecError(what, where=where, hint=hint)


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")


@cache
def adapter(cls: type) -> Any:
    """Return the Pydantic ``TypeAdapter`` of a dataclass."""
    from pydantic import TypeAdapter

    return TypeAdapter(cls)


def _keys_at(cls: type, location: tuple[int | str, ...]) -> list[str]:
    """Return the valid keys of a nested table; ``location`` lists the keys that lead to the table."""
    for part in location:
        hint = get_type_hints(cls).get(str(part))
        inner = [c for c in (hint, *getattr(hint, "__args__", ())) if isinstance(c, type) and is_dataclass(c)]
        cls = inner[0] if inner else cls
    return [field.name for field in fields(cls)]


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        SpecError: The file is absent, cannot be read, or is not valid TOML.
    """
    try:
        return parse_toml(read_text(path), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError.unreadable(path, error) from None


def parse_toml(text: str, where: str) -> dict[str, object]:
    """Return the content of a TOML text.

    Raises:
        SpecError: The text is not valid TOML.
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise SpecError("is nested too deeply", where=where, hint="correct the syntax") from None
    except ValueError as error:  # TOMLDecodeError, or a number has more digits than Python converts.
        other = "JSON" if text.lstrip().startswith("{") else "YAML" if _YAML_LINE.search(text) else ""
        hint = f"this looks like {other}: in TOML write [table], then key = value" if other else "correct the syntax"
        raise SpecError(f"is not valid TOML ({error})", where=where, hint=hint) from None
