"""File formats of figures.  This module imports no slow package, because commands need it before they draw."""

from __future__ import annotations

from collections.abc import Iterable

from impact_posture.errors import InputError

FORMATS = ("png", "svg", "pdf")
# A PDF takes as long as three PNG files.
DEFAULT_FORMATS = ("png",)


def check_formats(formats: Iterable[str]) -> tuple[str, ...]:
    """Return the formats in lower case and without duplicates; raise ``InputError`` for an unknown format."""
    wanted = tuple(dict.fromkeys(f.lower().lstrip(".") for f in formats))
    for extension in wanted:
        if extension not in FORMATS:
            raise InputError(f"no format '{extension}'", where="plot", hint=f"choose from {', '.join(FORMATS)}")
    return wanted
