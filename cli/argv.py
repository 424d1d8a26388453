"""Rewrite arguments of the command line into a form that Typer can read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest

# Options whose value may be omitted.  The next argument is the value if it matches the pattern.
_OPTIONAL = {
    # The pattern allows fractions, because the option itself reports them as an error.
    "--tradeoff": re.compile(r"[+-]?[0-9.]+$"),
    "--write-robot-toml": re.compile(r".*\.toml$"),
}


def put_right(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with two changes.

    ``--payload FRAME MASS`` becomes ``--payload FRAME:MASS``, because a repeatable option of Typer cannot have two
    values.  If an option in ``_OPTIONAL`` has no value, the default value is added, because Typer requires a value.
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
            # Import the module here, so that --help stays fast.
            from impact_posture.config.problem_settings import TRADEOFF_POINTS

            filled.append(str(TRADEOFF_POINTS) if word == "--tradeoff" else "")
    return filled
