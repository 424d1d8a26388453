"""Words of the command line put into the form that Typer takes, before it reads them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest

from impact_posture.settings import TRADEOFF_POINTS


def put_right(arguments: Sequence[str]) -> list[str]:
    """Apply all of the below."""
    return fill_optional(in_pairs(arguments))


# Options whose value may be left out: what a value looks like, and what stands for none.
_OPTIONAL = {
    # Whole or not: what is no whole number is for the option itself to refuse.
    "--tradeoff": (re.compile(r"[+-]?[0-9.]+$"), str(TRADEOFF_POINTS)),
    "--write-robot-toml": (re.compile(r".*\.toml$"), ""),
}


def in_pairs(arguments: Sequence[str]) -> list[str]:
    """Write ``--payload FRAME MASS`` as ``--payload FRAME:MASS``: Typer has no repeatable options of two values."""
    found, rest = [], list(arguments)
    while rest:
        word = rest.pop(0)
        found.append(word)
        if word == "--payload" and len(rest) > 1 and not rest[1].startswith("--"):
            found.append(f"{rest.pop(0)}:{rest.pop(0)}")
    return found


def fill_optional(arguments: Sequence[str]) -> list[str]:
    """Give options of ``_OPTIONAL`` a value where none follows: Typer has none whose value may be left out."""
    filled: list[str] = []
    for word, following in zip_longest(arguments, arguments[1:], fillvalue=""):
        filled.append(word)
        if word in _OPTIONAL and not _OPTIONAL[word][0].match(following):
            filled.append(_OPTIONAL[word][1])
    return filled
