"""Rewrite Python parameters in messages as options of the command line.

Messages of the library hold parameters between backquotes, for example ``force=True`` or ``support=['foot']``.
"""

from __future__ import annotations

import ast
import os
import re
from functools import cache

# Options that are no settings.
_OTHERS = {
    "compile", "controller", "daqp", "force", "gain", "jobs", "mode", "mpi", "out", "prefix", "samples", "scheduler",
    "sign", "slurm",
}  # fmt: skip
# Parameters whose option has another name.
_RENAMED = {"build": "compile", "kind": "controller"}


@cache
def _names() -> set[str]:
    """Return the names that are options: settings and others."""
    # Imported here because the help page does without.
    from dataclasses import fields

    from impact_posture.settings import ProblemSettings

    return {f.name for f in fields(ProblemSettings)} - {"robot", "schema", "q", "support_compliance"} | _OTHERS


def as_options(text: str) -> str:
    """Write each setting between backquotes as an option."""
    return re.sub(r"`(\w+)(?:=([^`]*))?`", _as_option, text)


def option_of(where: str) -> str:
    """Write the place of an error as an option, where it is a setting or begins with a setting."""
    name, *rest = where.split(" ", maxsplit=1)
    return " ".join([_option(name), *rest]) if name in _names() and not os.path.exists(where) else where


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
    return f"--{_RENAMED.get(name, name).replace('_', '-')}"
