"""Files that contain the SHA-256 of their other content, so that any damage is noticed."""

from __future__ import annotations

from hashlib import sha256

_MARK, _DIGITS = b"sha256:", 64
# Text that a file contains in place of its SHA-256 before it is sealed.
UNSEALED = _MARK.decode() + "0" * _DIGITS


def sealed(content: bytes) -> bytes:
    """Insert the SHA-256 of all other bytes of a file after its last ``sha256:``, and return the new content."""
    begin, digest = _digest(content)
    return content[:begin] + digest + content[begin + _DIGITS :]


def is_intact(content: bytes) -> bool:
    """Return whether the content of a sealed file is undamaged."""
    begin, digest = _digest(content)
    return content[begin : begin + _DIGITS] == digest


def sealed_text(text: str) -> str:
    """Return a text after a first line with the SHA-256 of the text."""
    return f"{sha256(text.encode()).hexdigest()}\n{text}"


def opened_text(content: str) -> str:
    """Return the text of :func:`sealed_text`; raise ``ValueError`` if it is damaged."""
    text = content.partition("\n")[2]
    if content != sealed_text(text):
        raise ValueError("the SHA-256 differs")
    return text


def _digest(content: bytes) -> tuple[int, bytes]:
    begin = content.rfind(_MARK) + len(_MARK)
    digest = sha256(memoryview(content)[:begin])
    digest.update(memoryview(content)[begin + _DIGITS :])
    return begin, digest.hexdigest().encode()
