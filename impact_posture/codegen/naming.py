"""What the C names of an export are; needs nothing but the names."""

from __future__ import annotations

import re
from collections.abc import Sequence

from impact_posture.errors import InputError
from impact_posture.escape import identifier

_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# <prefix>.h would be included instead of the C library's.
_C_HEADERS = frozenset(
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef"
    " stdint stdio stdlib string tgmath time wchar wctype".split()
)

FUNCTIONS = ("eval", "objective", "value", "jump", "ellipsoid", "eval_batch")
"""What each frame of an export has, as ``<stem>_<function>``."""


def c_identifier(robot: str, frame: str) -> str:
    """Robot and frame as one C identifier: what is no letter, digit or underscore becomes an underscore."""
    text = identifier(f"{robot}_{frame}")
    return text if _IDENTIFIER.fullmatch(text) else f"robot_{text}".rstrip("_")


def check_prefix(prefix: str) -> str:
    """Return a prefix that C takes.

    Raises:
        InputError: It is no C identifier, or the name of the example or of a header of C's.
    """
    if not _IDENTIFIER.fullmatch(prefix):
        raise InputError(
            f"the prefix '{prefix}' is no C identifier",
            where="--prefix",
            hint=f"letters, digits and underscores, a letter first, such as {c_identifier(prefix, '')}",
        )
    if prefix.lower() == "example":
        raise InputError("the prefix 'example' is taken by example.c", where="--prefix", hint="choose another")
    if prefix.lower() in _C_HEADERS:
        raise InputError(f"the prefix '{prefix}' is taken by C's {prefix}.h", where="--prefix", hint="choose another")
    return prefix


def stems(prefix: str, frames: Sequence[str]) -> tuple[str, ...]:
    """What the functions of each frame begin with: the prefix alone for one frame, else prefix and frame.

    Raises:
        InputError: Two frames that are one, or the same as C identifiers.
    """
    if len(frames) == 1:
        return (prefix,)
    found: dict[str, str] = {}
    for frame in frames:
        stem = f"{prefix}_{identifier(frame)}"
        if stem in found:
            other = found[stem]
            what = f"'{frame}' is given twice" if other == frame else f"'{other}' and '{frame}' are one name in C"
            raise InputError(what, where="--frame", hint="give each frame once, or export one by one")
        found[stem] = frame
    return tuple(found)
