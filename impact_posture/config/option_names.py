"""Rewrite Python parameters in messages as options of the command line, or as keys of a file.

Messages of the library hold parameters between backquotes, for example ``force=True`` or ``support=['foot']``.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Mapping
from functools import cache

# Options that are no settings.
_OTHERS = {
    "compile", "controller", "daqp", "force", "gain", "jobs", "mode", "mpi", "out", "prefix", "samples", "scheduler",
    "sign", "slurm",
}  # fmt: skip
# Parameters whose option has another name.
_RENAMED = {"build": "compile", "kind": "objective"}
# Those whose option depends on the value: a kind of controller is none of an impact.
_RENAMED_WITH = {("kind", kind): "controller" for kind in ("aerial", "legged", "arm")}
_PARAMETER = re.compile(r"`(\w+)(?:=([^`]*))?`")


@cache
def _names() -> set[str]:
    """Return the names that are options: settings and others."""
    # Imported here because the help page does without.
    from dataclasses import fields

    from impact_posture.config.settings import ProblemSettings

    keys = {"robot", "schema", "q", "support_compliance", "obstacles"}
    return {f.name for f in fields(ProblemSettings)} - keys | _OTHERS


def as_options(text: str) -> str:
    """Write each setting between backquotes as an option."""
    return _PARAMETER.sub(_as_option, text)


def as_keys(text: str, renamed: Mapping[str, str]) -> str:
    """Write each setting between backquotes as a key of a file.

    Args:
        text: The message.
        renamed: Settings whose key has another name, with that name.
    """

    def key(found: re.Match[str]) -> str:
        name = renamed.get(found[1], found[1])
        return name if found[2] is None else f"{name} = {found[2]}"

    return _PARAMETER.sub(key, text)


def option_of(where: str) -> str:
    """Write the place of an error as an option, where it is a setting or begins with a setting."""
    name, *rest = where.split(" ", maxsplit=1)
    return " ".join([_option(name), *rest]) if name in _names() and not os.path.exists(where) else where


def _as_option(found: re.Match[str]) -> str:
    name, text = found[1], found[2]
    if text is None:
        return _option(name)
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = text
    option = _option(_RENAMED_WITH.get((name, str(value)), name))
    if value is True:
        return option
    if value is False or value in ([], ()):
        return option.replace("--", "--no-", 1)
    return " ".join(f"{option} {one}" for one in (value if isinstance(value, list | tuple) else [value]))


def _option(name: str) -> str:
    return f"--{_RENAMED.get(name, name).replace('_', '-')}"
