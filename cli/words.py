"""Words of the command line put into the form that Typer takes, before it reads them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest

from impact_posture_cli.options import TRADEOFF_POINTS

# Whole or not: what is no whole number is for the option itself to refuse.
_NUMBER = re.compile(r"[+-]?[0-9.]+$")


def put_right(arguments: Sequence[str]) -> list[str]:
    """Apply all of the below."""
    return fill_optional(in_pairs(arguments))


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
    """Give ``--tradeoff`` its number where none follows: Typer has no options whose value may be left out."""
    filled: list[str] = []
    for word, following in zip_longest(arguments, arguments[1:], fillvalue=""):
        filled.append(word)
        if word == "--tradeoff" and not _NUMBER.match(following):
            filled.append(str(TRADEOFF_POINTS))
    return filled
