"""Names and signatures of the C functions of an export."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from impact_posture.errors import InputError
from impact_posture.system.escape import identifier

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# A file <prefix>.h would hide the header of the C library.
_C_HEADERS = frozenset(
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef"
    " stdint stdio stdlib string tgmath time wchar wctype".split()
)

SIGNATURES: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "eval": (("q", "n"), ("H", "grad")),
    "objective": (("q",), ("value", "grad")),
    "value": (("q", "n"), ("H",)),
    "jump": (("q", "n"), ("a", "G", "V")),
    "ellipsoid": (("q",), ("L",)),
}
"""Name of each C function → its inputs and its results, in the order of its parameters."""

FUNCTIONS = (*SIGNATURES, "eval_batch")
"""The functions of each frame; their C names are ``<stem>_<function>``."""


def lengths(nq: int, nv: int) -> dict[str, int]:
    """Return the length of each parameter that is an array; the other parameters are single numbers."""
    return {"q": nq, "n": 3, "grad": nv, "a": nv, "L": 9}


def products(prefix: str) -> tuple[str, ...]:
    """Return the files that the Makefile of an export, or a program that loads it, makes beside the export."""
    library = f"lib{prefix}.so"
    return ("example", "example_cpp", f"{prefix}.o", library, f"{library}.sha256")


def c_identifier(robot: str, frame: str) -> str:
    """Return robot and frame as one C identifier, with an underscore for every other character."""
    text = identifier(f"{robot}_{frame}")
    return text if _IDENTIFIER.fullmatch(text) else f"robot_{text}".rstrip("_")


def check_prefix(prefix: str) -> str:
    """Return a prefix that C accepts.

    Raises:
        InputError: The prefix is no C identifier, or the name of the example or of a C header.
    """
    if not _IDENTIFIER.fullmatch(prefix):
        raise InputError(
            f"the prefix '{prefix}' is no C identifier",
            where="prefix",
            hint=f"letters, digits and underscores, a letter first, such as {c_identifier(prefix, '')}",
        )
    if prefix.lower() == "example":
        raise InputError("the prefix 'example' is taken by example.c", where="prefix", hint="choose another")
    if prefix.lower() in _C_HEADERS:
        raise InputError(
            f"the prefix '{prefix}' is the name of the C header {prefix}.h", where="prefix", hint="choose another"
        )
    return prefix


def stems(prefix: str, frames: Sequence[str]) -> tuple[str, ...]:
    """Return what the function names of each frame begin with: the prefix for one frame, else prefix and frame.

    Raises:
        InputError: A frame is given twice, or two frames have the same C identifier.
    """
    if len(frames) == 1:
        return (prefix,)
    found: dict[str, str] = {}
    for frame in frames:
        stem = f"{prefix}_{identifier(frame)}"
        if stem in found:
            other = found[stem]
            what = f"'{frame}' is given twice" if other == frame else f"'{other}' and '{frame}' are one name in C"
            raise InputError(what, where="frame", hint="give each frame once, or export one by one")
        found[stem] = frame
    return tuple(found)
