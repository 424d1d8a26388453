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
    """Write ``--payload FRAME MASS`` as ``--payload FRAME:MASS``, and give options of ``_OPTIONAL`` a missing value.

    Typer has neither repeatable options of two values nor options with an optional value.
    """
    words, rest = [], list(arguments)
    while rest:
        word = rest.pop(0)
        words.append(word)
        if word == "--payload" and len(rest) > 1 and not rest[1].startswith("--"):
            words.append(f"{rest.pop(0)}:{rest.pop(0)}")
    filled: list[str] = []
    for word, following in zip_longest(words, words[1:], fillvalue=""):
        filled.append(word)
        if word in _OPTIONAL and not _OPTIONAL[word].match(following):
            # Imported here, because --help does without.
            from impact_posture.config.problem_settings import TRADEOFF_POINTS

            filled.append(str(TRADEOFF_POINTS) if word == "--tradeoff" else "")
    return filled
