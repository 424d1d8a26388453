"""Text of a drafted ``robot.toml``, with the source of every value."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field

from impact_posture.errors import printable
from impact_posture.system.escape import toml

_WIDTH = 100


@dataclass
class Draft:
    """Lines of a ``robot.toml``, and a line for each guessed value, which the user must check."""

    lines: list[str] = field(default_factory=list)
    guesses: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """Text of the file."""
        return "\n".join(self.lines) + "\n"

    def key(self, name: str, value: object, why: str, *, guessed: bool = False) -> None:
        """Add a key and the source of its value."""
        line, comment = f"{name} = {toml(value)}", comment_lines(f"GUESS: {why}" if guessed else why)
        beside = f"{line}  {comment[0]}"
        self.lines += [beside] if len(comment) == 1 and len(beside) <= _WIDTH else [*comment, line]
        if guessed:
            self.guesses.append(f"{line}: {why}")

    def note(self, text: str, *example: str) -> None:
        """Add a comment, and an example that a user can uncomment."""
        self.lines += ["", *comment_lines(text), *(f"# {line}".rstrip() for line in example)]


def comment_lines(text: str) -> list[str]:
    """Return a text as lines of a TOML comment.  Line breaks in names are escaped."""
    wrapper = textwrap.TextWrapper(_WIDTH - 2, break_long_words=False, break_on_hyphens=False)
    return [f"# {line}" for line in wrapper.wrap(printable(text))]
