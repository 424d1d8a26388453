"""Parsers of contacts, armatures and payloads that users write as text."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from impact_posture.errors import ContactError, InputError


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
    if len(texts) == 1 and ("=" not in texts[0] or os.path.isfile(texts[0])):
        return texts[0]
    values: dict[str, float] = {}
    for text in texts:
        joint, equals, value = text.rpartition("=")
        try:
            if not equals:
                raise ValueError
            values[joint] = float(value)
        except ValueError:
            raise InputError(
                f"'{text}' is not JOINT=VALUE", where="armature", hint="give none, one file, or only JOINT=VALUE"
            ) from None
    _check_once([text.rpartition("=")[0] for text in texts], "armature")
    return values


def parse_xacro_arguments(texts: Sequence[str]) -> Mapping[str, str]:
    """Read texts ``NAME:=VALUE``; raise ``InputError`` for another form."""
    values: dict[str, str] = {}
    for text in texts:
        name, sign, value = text.partition(":=")
        if not (name and sign):
            raise InputError(f"'{text}' is not NAME:=VALUE", where="xacro_arg", hint="for example hand:=true")
        values[name] = value
    _check_once([text.partition(":=")[0] for text in texts], "xacro_arg")
    return values


def _check_once(names: Sequence[str], where: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"'{name}' has two values", where=where, hint="remove one")


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
