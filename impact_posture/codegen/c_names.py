"""C identifiers of an export, and names of the files that a build of an export creates."""

from __future__ import annotations

import re

from impact_posture.errors import InputError
from impact_posture.system.escape import identifier

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# Names of headers of the C library.  A file <prefix>.h with one of these names would hide the header.
_C_HEADERS = frozenset(
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef"
    " stdint stdio stdlib string tgmath time wchar wctype".split()
)


def products(prefix: str) -> tuple[str, ...]:
    """Return the files that the Makefile of an export, or a program that loads the export, creates in its folder."""
    library = f"lib{prefix}.so"
    return ("example", "example_cpp", "example_cuda", f"{prefix}.o", library, f"{library}.sha256")


def c_identifier(robot: str, frame: str) -> str:
    """Return robot name and frame name as one C identifier; underscores replace characters that C does not allow."""
    text = identifier(f"{robot}_{frame}")
    return text if _IDENTIFIER.fullmatch(text) else f"robot_{text}".rstrip("_")


def check_prefix(prefix: str) -> str:
    """Return the prefix if it can be used in C names and file names.

    Raises:
        InputError: The prefix is not a C identifier, or it is ``example`` or the name of a C header.
    """
    what, hint = "", "choose another prefix"
    if not _IDENTIFIER.fullmatch(prefix):
        what = f"the prefix '{prefix}' is not a C identifier"
        hint = f"use letters, digits and underscores, a letter first, such as {c_identifier(prefix, '')}"
    elif prefix.lower() == "example":
        what = "the prefix 'example' is reserved for example.c"
    elif prefix.lower() in _C_HEADERS:
        what = f"the prefix '{prefix}' is the name of the C header {prefix}.h"
    if what:
        raise InputError(what, where="prefix", hint=hint)
    return prefix
