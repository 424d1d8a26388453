"""Output of the commands: Rich tables for people, a JSON document for programs, warnings on standard error."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from impact_posture.errors import one_line, printable

if TYPE_CHECKING:
    from rich.console import Console


def as_options(text: str) -> str:
    """Write each parameter between backquotes as an option: ```out``` as ``--out``, no ```com``` as ``--no-com``."""
    return re.sub(r"(no )?`(\w+)`", lambda m: f"--{'no-' if m[1] else ''}{m[2].replace('_', '-')}", text)


def print_json(document: object) -> None:
    """Write a strictly valid JSON document to standard output. NaN and infinity raise ``ValueError``."""
    sys.stdout.write(json.dumps(document, indent=1, allow_nan=False) + "\n")


def complain(line: str) -> None:
    """Write a line to standard error."""
    sys.stderr.write(f"{one_line(line)}\n")


class Page:
    """Titled tables on standard output, and warnings on standard error."""

    def __init__(self, *, quiet: bool = False) -> None:
        from rich.console import Console

        self.console: Console = Console(highlight=False, soft_wrap=False)
        self.quiet = quiet

    def title(self, text: str, detail: str = "") -> None:
        """Write a bold line."""
        from rich.text import Text

        line = Text(printable(text), style="bold")
        if detail:
            line.append(f"  {printable(detail)}", style="not bold dim")
        self.console.print(line)

    def line(self, text: str, *, style: str = "") -> None:
        """Write a paragraph, wrapped at words."""
        from rich.text import Text

        self.console.print(Text(printable(as_options(text)), style=style))

    def gap(self) -> None:
        """Write an empty line."""
        self.console.print()

    def pairs(self, rows: Iterable[tuple[str, str]]) -> None:
        """Write two columns: names and values."""
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
        """Write a table of plain text, which Rich does not read as markup; empty ``headers`` leave the titles out.

        The columns ``right`` are aligned to the right, and the column ``dim`` has dim letters. Only the column
        ``fold`` wraps where the terminal is too narrow.
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

    def warnings(self, lines: Iterable[str]) -> None:
        """Write each warning on a line of standard error, unless quiet."""
        if not self.quiet:
            for line in lines:
                complain(f"warning: {as_options(line)}")


def number(value: float | None, unit: str = "", *, missing: str = "undefined") -> str:
    """Format a number with four significant digits and a unit; return ``missing`` for ``None``."""
    if value is None:
        return missing
    text = f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}"
    return f"{text} {unit}".rstrip()


def vector(values: Iterable[Any]) -> str:
    """Format a unit vector with numbers of equal width."""
    # Adding zero turns -0.0 into 0.0.
    return " ".join(f"{round(float(v), 3) + 0.0:6.3f}" for v in values).strip()


def worst_normal(block: dict[str, Any], normal: Iterable[Any]) -> str:
    """Describe where in the cone the worst normal lies, from the ``cone`` block of an evaluation."""
    others = len(block["normals"]) - 1
    tied = f", tied: {vector(block['normals'][1])} is as bad" if others else ""
    more = f", and {others - 1} more" if others > 1 else ""
    return f"{vector(normal)} (world), {block['angle_deg']:.3g}° from n{tied}{more}"
