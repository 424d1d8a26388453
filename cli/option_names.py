"""Settings in the library's messages, written as the options that a command line takes.

The library names Python parameters, between backquotes in a sentence: ``force=True``, ``support=['foot']``.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

# Options that are no settings.
_OTHERS = {"compile", "controller", "force", "gain", "jobs", "mode", "out", "prefix", "samples", "sign"}


@cache
def _names() -> set[str]:
    """Names that are options: of settings, and the others."""
    # Imported here because the help page does without.
    from dataclasses import fields

    from impact_posture.settings import ProblemSettings

    return {f.name for f in fields(ProblemSettings)} - {"robot", "schema", "q", "support_compliance"} | _OTHERS


def as_options(text: str) -> str:
    """Write each setting between backquotes as an option."""
    return re.sub(r"`(\w+)(?:=([^`]*))?`", _as_option, text)


def option_of(where: str) -> str:
    """Write the place of an error as an option, where it is a setting; a setting may be the first of two words."""
    name, *rest = where.split(" ", maxsplit=1)
    return " ".join([_option(name), *rest]) if name in _names() and not Path(where).exists() else where


def _as_option(found: re.Match[str]) -> str:
    option, text = _option(found[1]), found[2]
    if text is None:
        return option
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = text
    if value is True:
        return option
    if value is False or value in ([], ()):
        return option.replace("--", "--no-", 1)
    return " ".join(f"{option} {one}" for one in (value if isinstance(value, list | tuple) else [value]))


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
