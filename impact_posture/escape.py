"""Names as text in other languages.  The names of robots, joints, frames and files are data, whoever chose them.

Every name that leaves the program goes through one of these functions, by the language that it enters.
"""

from __future__ import annotations

import json
import re
import unicodedata
import zlib

# What our own texts write that C comments should not rely on a compiler to read.
_ASCII = str.maketrans({"·": " ", "²": "^2", "×": "x", "λ": "l", "ε": "eps", "⁻": "^-", "¹": "1"})
# Linkers and file systems take more (255 bytes a file name), with room for what is appended.
_LONGEST_IDENTIFIER, _LONGEST_FILE_NAME, _LONGEST_LABEL = 100, 120, 60


def printable(text: str, *, keep: str = "", longest: int = 0) -> str:
    r"""Return text without anything that steers a terminal or turns the direction of writing.

    Control and format characters, line separators and lone surrogates become ``\x1b``, ``\u202e`` and the like.

    Args:
        text: Any text.
        keep: Characters that stay, such as line breaks.
        longest: Leave the middle of a longer text away; 0 keeps all of it.
    """
    if longest and len(text) > longest:
        half = longest // 2
        text = f"{text[:half]}…{text[len(text) - half + 1 :]}"
    if text.isprintable():
        return text
    return "".join(c if c in keep or _is_visible(c) else _code_point(c) for c in text)


def _is_visible(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"


def _code_point(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def identifier(text: str) -> str:
    """Return letters, digits and single underscores of ASCII; a long text ends in a checksum of all of it."""
    found = re.sub(r"_{2,}", "_", re.sub(r"[^A-Za-z0-9]", "_", text)).strip("_")
    if len(found) <= _LONGEST_IDENTIFIER:
        return found
    return f"{found[: _LONGEST_IDENTIFIER - 9]}_{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"


def file_name(text: str) -> str:
    """Return the name of a file or folder: no separator, no leading dot or dash, not too long for a file system."""
    found = re.sub(r"[^\w.+@=-]", "_", text).lstrip(".-")
    return found.encode("utf-8", "replace")[:_LONGEST_FILE_NAME].decode("utf-8", "ignore") or "_"


def c_comment(text: str) -> str:
    """Return text that neither ends a comment of C or C++ nor continues it on the next line."""
    return re.sub(r"[^A-Za-z0-9 _.,:;+()\[\]=<>^'/|@#%&!-]", "_", text.translate(_ASCII))


def toml(value: object) -> str:
    """Return a value of TOML, on one line, which reads back as the same.

    Raises:
        UnicodeEncodeError: A text holds half a surrogate pair (a path that is not UTF-8), which TOML cannot.
    """
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml(str(key))} = {toml(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    # JSON's integers and booleans are TOML's, and its strings but for pairs of surrogates, which TOML has none of.
    text = json.dumps(value, ensure_ascii=False)
    text.encode("utf-8")
    return "".join(c if _is_visible(c) else rf"\U{ord(c):08X}" for c in text)


def xml_name(text: str) -> str:
    """Return a name that XML can hold and MuJoCo finds again; an empty one would be none there."""
    return printable(text) or "(empty)"


def markdown(text: str) -> str:
    """Return text that stands as it is in Markdown, in a cell of a table too."""
    # A bracket alone is no link, and underscores between letters emphasize nothing.
    return re.sub(r"[\\`*<>|&$~#!]|\](?=[\[(:]|$)|_+", _escape_markdown, printable(text))


def _escape_markdown(found: re.Match[str]) -> str:
    before, after = found.string[: found.start()][-1:], found.string[found.end() :][:1]
    within_a_word = found[0][0] == "_" and before.isalnum() and after.isalnum()
    return found[0] if within_a_word else "".join(f"\\{c}" for c in found[0])


def plot_label(text: str) -> str:
    """Return a label for matplotlib, which reads dollars as mathematics and hides what begins with an underscore."""
    found = printable(text, longest=_LONGEST_LABEL).replace("$", r"\$")
    return f" {found}" if found.startswith("_") else found
