"""Convert arguments of the command line to a form that Typer can read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest

# Options whose value may be missing, and the pattern that a value matches.
_OPTIONAL = {
    # Match any number, because the option itself reports a fraction as an error.
    "--tradeoff": re.compile(r"[+-]?[0-9.]+$"),
    "--write-robot-toml": re.compile(r".*\.toml$"),
}


def put_right(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with two changes that Typer requires.

    ``--payload FRAME MASS`` becomes ``--payload FRAME:MASS``, because a repeatable option cannot have two values in
    Typer.  Options in ``_OPTIONAL`` without a value get their default value, because Typer requires a value.
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
            # Imported here, because --help does not need this module.
            from impact_posture.config.problem_settings import TRADEOFF_POINTS

            filled.append(str(TRADEOFF_POINTS) if word == "--tradeoff" else "")
    return filled
