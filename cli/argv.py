"""Rewrite arguments of the command line into a form that Typer can read."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest

# Options whose value may be omitted.  The next argument is the value if it matches the pattern.
_OPTIONAL = {
    # The pattern permits fractions, because the option itself reports a fraction as an error.
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


def split_vectors(arguments: Sequence[str], lengths: Mapping[str, int]) -> list[str]:
    """Return the arguments with each vector as separate words: ``0,0,1`` or ``[0, 0, 1]`` becomes ``0 0 1``.

    ``lengths`` maps the options that take several numbers to the count of their numbers.
    """
    words, left = list[str](), 0
    for word in arguments:
        option, equals, value = word.partition("=")
        if option in lengths:
            words.append(option)
            left, word = lengths[option], value
            if not equals:
                continue
        parts = re.split(r"[,\s]+", word.strip("[]() ,")) if left > 0 else [word]
        words += parts
        left -= len(parts)
    return words
