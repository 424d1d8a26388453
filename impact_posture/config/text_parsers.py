"""Parsers of contacts, armatures, payloads and numbers that users write as text."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

from impact_posture.errors import ContactError, InputError

_Value = TypeVar("_Value")


def parse_contact(text: str) -> tuple[str, tuple[float, float, float], float | None]:
    """Read ``FRAME:NX,NY,NZ[:IMPULSE]``; the name of the frame may contain colons.

    Raises:
        ContactError: The text does not have this form.
    """
    hint = "write FRAME:NX,NY,NZ or FRAME:NX,NY,NZ:IMPULSE"
    parts = text.split(":")
    impulse: float | None = None
    try:
        if len(parts) > 2 and "," not in parts[-1]:
            impulse = float(parts.pop())
        x, y, z = (float(v) for v in parts[-1].split(","))
    except ValueError:
        raise ContactError(f"'{text}' is not a contact", where="contact", hint=hint) from None
    frame = ":".join(parts[:-1])
    if not frame:
        raise ContactError(f"'{text}' names no frame", where="contact", hint=hint)
    return frame, (x, y, z), impulse


def parse_armature(texts: Sequence[str]) -> Mapping[str, float] | str | None:
    """Read ``--armature``: ``none``, one file, or any number of ``JOINT=VALUE``.

    Raises:
        InputError: The forms are mixed, or a value is not a number.
    """
    if not texts:
        return None
    if len(texts) == 1 and (os.path.isfile(texts[0]) or not ("=" in texts[0] or finite_numbers(texts[0]))):
        return texts[0]
    values = []
    for text in texts:
        joint, equals, value = text.rpartition("=")
        try:
            if not equals:
                raise ValueError
            values.append((joint, float(value)))
        except ValueError:
            hint = "give none, one file, or only JOINT=VALUE; for all joints, set [armature] default in robot.toml"
            raise InputError(f"'{text}' is not JOINT=VALUE", where="armature", hint=hint) from None
    return _each_once(values, "armature")


def parse_xacro_arguments(texts: Sequence[str]) -> Mapping[str, str]:
    """Read texts ``NAME:=VALUE``; raise ``InputError`` for another form."""
    values = []
    for text in texts:
        name, sign, value = text.partition(":=")
        if not (name and sign):
            raise InputError(f"'{text}' is not NAME:=VALUE", where="xacro_arg", hint="for example hand:=true")
        values.append((name, value))
    return _each_once(values, "xacro_arg")


def _each_once(pairs: Iterable[tuple[str, _Value]], where: str) -> dict[str, _Value]:
    values = dict[str, _Value]()
    for name, value in pairs:
        if name in values:
            raise InputError(f"'{name}' has two values", where=where, hint="remove one")
        values[name] = value
    return values


def finite_numbers(text: str, count: int = 1) -> list[float]:
    """Read ``count`` finite numbers separated by spaces; return an empty list for any other text."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return []
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else []


def parse_payloads(texts: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Read texts ``FRAME:MASS``; the name of a frame may contain colons.

    Raises:
        InputError: A text does not have this form.
    """
    payloads = []
    for text in texts:
        frame, _, mass = text.rpartition(":")
        try:
            payloads.append((frame, float(mass)))
        except ValueError:
            frame = ""
        if not frame:
            raise InputError(f"'{text}' is not a payload", where="payload", hint="give a frame and kg: FRAME MASS")
    return tuple(payloads)


def parse_number_or_name(text: str) -> float | str:
    """Convert a text to a number; if this is impossible, return the text unchanged."""
    try:
        return float(text)
    except ValueError:
        return text
