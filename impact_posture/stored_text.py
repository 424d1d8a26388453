"""Texts in the cache of the user.  A text that is damaged, or that another user may write, is not used."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from impact_posture.errors import OutputError
from impact_posture.libraries import cache_folder, check_private
from impact_posture.output_folder import write_whole

# The longest text that is read, bytes.  The longest one of the catalogue needs a third of it.
_LONGEST = 10_000_000


def read_stored(kind: str, key: str) -> str | None:
    """Return the text of a kind and key; ``None`` where no file can be used."""
    with suppress(OSError, OutputError, ValueError):
        path = _path(kind, key)
        check_private(path)
        if path.stat().st_size <= _LONGEST:
            seal, text = path.read_text(encoding="utf-8").split("\n", 1)
            return text if seal == _seal(text) else None
    return None


def write_stored(kind: str, key: str, text: str) -> None:
    """Store the text of a kind and key, if the cache can be written."""
    with suppress(OSError, OutputError):
        write_whole(_path(kind, key), f"{_seal(text)}\n{text}")


def _path(kind: str, key: str) -> Path:
    return cache_folder(kind) / f"{key}.json"


def _seal(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
