"""Store values in the user's cache.  Damaged files, and files that another user may write, are ignored."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainSerializer, PlainValidator

from impact_posture.config.table_validation import adapter
from impact_posture.errors import OutputError
from impact_posture.system.libraries import cache_folder, check_private
from impact_posture.system.output_folder import write_whole
from impact_posture.system.sealed_files import opened_text, sealed_text
from impact_posture.system.text_files import read_text

_Value = TypeVar("_Value", bound=Hashable)

# Largest cache file that is read, bytes.  The largest file for a robot of this package has a third of this size.
_LONGEST = 10_000_000

# Whether values may be stored, for each call of ``make`` that is running.
_STORABLE: list[bool] = []


def _packed(array: NDArray[Any]) -> tuple[str, tuple[int, ...], str]:
    return array.dtype.str, array.shape, b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _unpacked(stored: tuple[str, tuple[int, ...], str]) -> NDArray[Any]:
    kind, shape, text = stored
    return np.frombuffer(b64decode(text), kind).reshape(shape).copy()


StoredArray = Annotated[NDArray[Any], PlainValidator(_unpacked), PlainSerializer(_packed)]
"""Annotation of an array in a stored dataclass."""


def cached(kind: str, key: str, cls: type[_Value], make: Callable[[], _Value]) -> _Value:
    """Return the value of the file ``<kind>/<key>.json`` in the cache; without a valid file, compute and store it.

    ``cls`` is the type of the value: a dataclass, or a tuple of dataclasses.  ``make`` computes the value.  If the
    cache cannot be written, the value is returned without being stored.
    """
    with suppress(OSError, OutputError, TypeError, ValueError):
        path = cache_folder(kind) / f"{key}.json"
        check_private(path)
        if path.stat().st_size <= _LONGEST:
            stored: _Value = adapter(cls).validate_json(opened_text(read_text(path)))
            return stored
    _STORABLE.append(True)
    try:
        value = make()
    finally:
        storable = _STORABLE.pop()
    if not storable:
        return value
    text = adapter(cls).dump_json(value).decode()
    with suppress(OSError, OutputError):
        write_whole(cache_folder(kind) / f"{key}.json", sealed_text(text))
    return value


def do_not_store() -> None:
    """Do not store the values that are being computed, because another attempt may give other values."""
    _STORABLE[:] = [False] * len(_STORABLE)
