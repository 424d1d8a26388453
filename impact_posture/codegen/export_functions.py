"""Names, parameters and results of the C functions of an export."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from impact_posture.errors import InputError
from impact_posture.system.escape import identifier

SIGNATURES: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "eval": (("q", "n"), ("H", "grad")),
    "objective": (("q",), ("value", "grad")),
    "value": (("q", "n"), ("H",)),
    "jump": (("q", "n"), ("a", "G", "V")),
    "ellipsoid": (("q",), ("L",)),
}
"""C function → its inputs and its results, in the order of the parameters.  Batch functions are not included."""


FUNCTIONS = (*SIGNATURES, "eval_batch", "objective_batch")
"""Names of the functions that each frame has; the C names are ``<stem>_<function>``."""

BLOCK_THREADS = 128
"""Number of threads in a block of the CUDA kernels.  On an H100, the speed is nearly the same from 32 to 256."""


def lengths(nq: int, nv: int) -> dict[str, int]:
    """Return parameter name → length, for parameters that are arrays.  All other parameters are single numbers."""
    return {"q": nq, "n": 3, "grad": nv, "a": nv, "L": 9}


def stems(prefix: str, frames: Sequence[str]) -> tuple[str, ...]:
    """Return the stem of each frame, which is the text with which its function names begin.

    For one frame, the stem is the prefix.  For several frames, the stem consists of prefix and frame name.

    Raises:
        InputError: A frame is given twice, or two frames have the same C identifier.
    """
    if len(frames) == 1:
        return (prefix,)
    frame_of: dict[str, str] = {}
    for frame in frames:
        stem = f"{prefix}_{identifier(frame)}"
        if stem in frame_of:
            other = frame_of[stem]
            what = f"'{frame}' is given twice" if other == frame else f"'{other}' and '{frame}' have the same C name"
            raise InputError(what, where="frame", hint="give each frame once, or export each frame separately")
        frame_of[stem] = frame
    return tuple(frame_of)
