"""Directive ``api-reference PACKAGE…``, which writes a section for each module of the packages."""

from __future__ import annotations

import pkgutil
from importlib import import_module
from typing import TYPE_CHECKING, Any

from generated_markdown import add_directive

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = "impact_posture"


def modules(name: str) -> list[str]:
    """Return a module, or the public modules of a package.  The package comes first if it exports names itself."""
    full = f"{ROOT}.{name}"
    package = import_module(full)
    if not hasattr(package, "__path__"):
        return [full]
    inner = sorted((module.name, module.ispkg) for module in pkgutil.walk_packages(package.__path__, f"{full}."))
    public = [name for name, folder in inner if not folder or getattr(import_module(name), "__all__", ())]
    return [full, *public] if getattr(package, "__all__", ()) else public


def markdown(names: list[str]) -> str:
    """Write a heading and an ``automodule`` for each module."""
    parts = []
    for module in (m for name in names for m in modules(name)):
        parts += [
            f"## `{module.removeprefix(ROOT + '.')}`",
            "",
            "```{eval-rst}",
            f".. automodule:: {module}",
            # Leave out the method that matplotlib adds, with its own markup, to every class derived from an artist.
            "   :exclude-members: set",
            "```",
            "",
        ]
    return "\n".join(parts)


def setup(app: Sphinx) -> dict[str, Any]:
    return add_directive(app, "api-reference", markdown)
