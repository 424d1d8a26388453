"""Output of the commands: Rich tables for people, a JSON document for programs, warnings on standard error."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from impact_posture.errors import one_line, printable
from impact_posture_cli.progress_line import progress

if TYPE_CHECKING:
    from rich.console import Console


# Options of the subcommand that runs; empty before a subcommand is known.
_OPTIONS: set[str] = set()


def use_options(options: Iterable[str]) -> None:
    """State the options of the subcommand that runs, for :func:`as_options`."""
    _OPTIONS.clear()
    _OPTIONS.update(options)


def as_options(text: str) -> str:
    """Replace each parameter name in backquotes by its option, for example ```out``` by ``--out``.

    If the subcommand has no such option, the name is printed in quotes, because the parameter is then a key of a
    file.  A name after "optimize again with" always becomes an option, because ``optimize`` has this option.
    """

    def name(match: re.Match[str]) -> str:
        again, no = match[1] or "", match[2] or ""
        option = f"--{'no-' if no else ''}{match[3].replace('_', '-')}"
        return again + (option if again or not _OPTIONS or option in _OPTIONS else f"{no}'{match[3]}'")

    return re.sub(r"(optimize again with )?(no )?`(\w+)`", name, text)


def print_json(document: object) -> None:
    """Write a valid JSON document to standard output.  Raise ``ValueError`` for NaN and infinity."""
    sys.stdout.write(json.dumps(document, indent=1, allow_nan=False) + "\n")


def complain(line: str) -> None:
    """Write one line to standard error."""
    sys.stderr.write(f"{one_line(line)}\n")


class Page:
    """Writes titles, lines and tables to standard output, and warnings and progress to standard error.

    Attributes:
        json: Whether standard output is one JSON document, without a progress line.
        quiet: Whether to leave out warnings, the progress line and advice.
    """

    def __init__(self, *, json: bool = False, quiet: bool = False) -> None:
        from rich.console import Console

        self.console: Console = Console(highlight=False, soft_wrap=False)
        self.json, self.quiet = json, quiet

    def progress(
        self, doing: str, unit: str = "", *, first: str = ""
    ) -> AbstractContextManager[Callable[[int, int], None] | None]:
        """Return a context that shows a progress line (:func:`.progress`)."""
        return progress(doing, unit, shown=not (self.quiet or self.json), first=first)

    def title(self, text: str, detail: str = "") -> None:
        """Write a bold title, with a dim ``detail`` after it."""
        from rich.text import Text

        line = Text(printable(text), style="bold")
        if detail:
            line.append(f"  {printable(detail)}", style="not bold dim")
        self.console.print(line)

    def line(self, text: str, *, style: str = "") -> None:
        """Write a paragraph; long lines are wrapped between words, and all lines keep the indent of the first."""
        from rich.padding import Padding
        from rich.text import Text

        words = text.lstrip(" ")
        paragraph, indent = Text(printable(as_options(words)), style=style), len(text) - len(words)
        self.console.print(Padding(paragraph, (0, 0, 0, indent), expand=False) if indent else paragraph)

    def gap(self) -> None:
        """Write an empty line."""
        self.console.print()

    def pairs(self, rows: Iterable[tuple[str, str]]) -> None:
        """Write a table with two columns: names and values."""
        self.table((), [(f"  {key}", value) for key, value in rows], dim=0)

    def table(
        self,
        headers: Sequence[str],
        rows: Iterable[Sequence[str]],
        *,
        right: Sequence[int] = (),
        dim: int | None = None,
        fold: int = -1,
    ) -> None:
        """Write a table of plain text, without the markup of Rich.

        If ``headers`` is empty, the table has no header. The columns ``right`` are aligned to the right, and the
        column ``dim`` is printed dim. If the terminal is too narrow, only the column ``fold`` is wrapped.
        """
        from rich.table import Table
        from rich.text import Text

        rows = [tuple(row) for row in rows]
        count = len(headers) or max((len(row) for row in rows), default=1)
        table = Table(box=None, show_header=bool(headers), padding=(0, 2, 0, 0), pad_edge=False)
        for k in range(count):
            header = Text(headers[k], style="bold") if headers else ""
            table.add_column(
                header,
                justify="right" if k in right else "left",
                style="dim" if k == dim else "",
                no_wrap=k != fold % count,
                overflow="fold",
            )
        for row in rows:
            table.add_row(*[Text(printable(cell)) for cell in row])
        self.console.print(table)

    def warnings(self, lines: Iterable[str | None]) -> None:
        """Write each warning that is not empty as a line to standard error, unless the page is quiet."""
        if not self.quiet:
            for line in filter(None, lines):
                complain(f"warning: {as_options(line)}")


def number(value: float | None, unit: str = "", *, missing: str = "undefined") -> str:
    """Return a number as text with four significant digits and its unit; return ``missing`` for ``None``."""
    if value is None:
        return missing
    text = f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def vector(values: Iterable[Any]) -> str:
    """Return a unit vector as text with numbers of equal width."""
    # Add zero, because -0.0 + 0.0 is 0.0.
    return " ".join(f"{round(float(v), 3) + 0.0:6.3f}" for v in values).strip()


def worst_normal(block: dict[str, Any], normal: Iterable[Any]) -> str:
    """Return a text that describes the worst normal.

    ``block`` is the ``cone`` block of an evaluation.
    """
    others = len(block["normals"]) - 1
    tied = f", tied: {vector(block['normals'][1])} is as bad" if others else ""
    more = f", and {others - 1} more" if others > 1 else ""
    return f"{vector(normal)} (world), {block['angle_deg']:.3g}° from n{tied}{more}"
