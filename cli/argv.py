"""Rewrite arguments of the command line to the form that Typer reads."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest

# Options whose value may be left out, and the pattern of a value.
_OPTIONAL = {
    # Any number, because the option itself refuses a fraction.
    "--tradeoff": re.compile(r"[+-]?[0-9.]+$"),
    "--write-robot-toml": re.compile(r".*\.toml$"),
}


def put_right(arguments: Sequence[str]) -> list[str]:
    """Join pairs and fill in optional values."""
    return fill_optional(_in_pairs(arguments))


def _in_pairs(arguments: Sequence[str]) -> list[str]:
    """Write ``--payload FRAME MASS`` as ``--payload FRAME:MASS``: Typer has no repeatable options of two values."""
    words, rest = [], list(arguments)
    while rest:
        word = rest.pop(0)
        words.append(word)
        if word == "--payload" and len(rest) > 1 and not rest[1].startswith("--"):
            words.append(f"{rest.pop(0)}:{rest.pop(0)}")
    return words


def fill_optional(arguments: Sequence[str]) -> list[str]:
    """Give options of ``_OPTIONAL`` a value where none follows: Typer has no options with an optional value."""
    filled: list[str] = []
    for word, following in zip_longest(arguments, arguments[1:], fillvalue=""):
        filled.append(word)
        if word in _OPTIONAL and not _OPTIONAL[word].match(following):
            # Imported here, because --help does without.
            from impact_posture.config.problem_settings import TRADEOFF_POINTS

            filled.append(str(TRADEOFF_POINTS) if word == "--tradeoff" else "")
    return filled
