"""Escape names of robots, joints, frames and files for output languages.

A name must never act as code in an output file.  This module has one function for each output language.
"""

from __future__ import annotations

import json
import re
import zlib
from dataclasses import asdict, is_dataclass

from impact_posture.errors import is_visible, printable

# ASCII replacements for symbols in our texts, because some compilers reject other characters in C comments.
_ASCII = str.maketrans({"·": " ", "²": "^2", "×": "x", "λ": "l", "ε": "eps", "⁻": "^-", "¹": "1"})
# Largest numbers of characters in an identifier, a file name and a label.  Linkers and file systems accept longer
# names (255 bytes per file name), so the program can add suffixes.
_LONGEST_IDENTIFIER, _LONGEST_FILE_NAME, _LONGEST_LABEL = 100, 120, 60


def identifier(text: str) -> str:
    """Return an identifier of ASCII letters, digits and single underscores; a long identifier ends in a checksum."""
    name = re.sub(r"_{2,}", "_", re.sub(r"[^A-Za-z0-9]", "_", text)).strip("_")
    if len(name) <= _LONGEST_IDENTIFIER:
        return name
    return f"{name[: _LONGEST_IDENTIFIER - 9]}_{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"


def file_name(text: str) -> str:
    """Return a file name of limited length, without path separators and without a dot or dash at the start."""
    name = re.sub(r"[^\w.+@=-]", "_", text).lstrip(".-")
    return name.encode("utf-8", "replace")[:_LONGEST_FILE_NAME].decode("utf-8", "ignore") or "_"


def c_comment(text: str) -> str:
    """Return text that can neither end a C or C++ comment nor continue a comment on the next line."""
    return re.sub(r"[^A-Za-z0-9 _.,:;+()\[\]=<>^'/|@#%&!-]", "_", text.translate(_ASCII))


def toml(value: object) -> str:
    """Return a value as TOML on one line.

    Raises:
        UnicodeEncodeError: A text contains a lone surrogate, which TOML forbids.  Python uses lone surrogates in
            paths that are not UTF-8.
    """
    if is_dataclass(value) and not isinstance(value, type):
        value = {key: item for key, item in asdict(value).items() if item is not None}
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml(str(key))} = {toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    # JSON and TOML have the same syntax for integers, booleans and strings, but TOML has no surrogate pairs.
    text = json.dumps(value, ensure_ascii=False)
    text.encode("utf-8")
    return "".join(c if is_visible(c) else rf"\U{ord(c):08X}" for c in text)


def xml_name(text: str) -> str:
    """Return a name that is valid in XML.  The name is not empty, because MuJoCo cannot look up empty names."""
    return printable(text) or "(empty)"


def markdown(text: str) -> str:
    """Escape text so that Markdown shows the text unchanged, also in a table cell."""
    # A single bracket makes no link, and an underscore between letters makes no emphasis, so they need no escape.
    return re.sub(r"[\\`*<>|&$~#!]|\](?=[\[(:]|$)|_+", _escape_markdown, printable(text))


def _escape_markdown(match: re.Match[str]) -> str:
    before, after = match.string[: match.start()][-1:], match.string[match.end() :][:1]
    within_a_word = match[0][0] == "_" and before.isalnum() and after.isalnum()
    return match[0] if within_a_word else "".join(f"\\{c}" for c in match[0])


def plot_label(text: str) -> str:
    """Escape a label for matplotlib, which reads ``$`` as math and hides labels that begin with an underscore."""
    label = printable(text, longest=_LONGEST_LABEL).replace("$", r"\$")
    return f" {label}" if label.startswith("_") else label
