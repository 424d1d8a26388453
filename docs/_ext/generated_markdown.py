"""Directives that insert generated Markdown into a page."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx


def add_directive(app: Sphinx, name: str, markdown: Callable[[list[str]], str]) -> dict[str, Any]:
    """Register a directive that inserts ``markdown(arguments)``, and return the metadata of the extension."""
    from docutils import nodes
    from sphinx.util.docutils import SphinxDirective

    class GeneratedMarkdown(SphinxDirective):
        """Insert the Markdown text."""

        optional_arguments = 30

        def run(self) -> list[nodes.Node]:
            return self.parse_text_to_nodes(markdown(self.arguments), allow_section_headings=True)

    app.add_directive(name, GeneratedMarkdown)
    return {"version": "1", "parallel_read_safe": True}
