"""Tables about the structure of the library, which are computed when the pages are built.

``package-structure`` lists files, lines and imports of each folder, ``module-map`` the first sentence of each module.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from generated_markdown import add_directive

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
PACKAGES = {"impact_posture": ROOT / "impact_posture", "impact_posture_cli": ROOT / "cli"}
SUFFIXES = {".py", ".c", ".cpp", ".hpp"}


def part_of(module: str) -> str:
    """Return the folder or module of the library to which a dotted name belongs.  The command line counts as one
    part.
    """
    names = module.split(".")
    if names[0] == "impact_posture_cli":
        return "cli"
    return names[1] if len(names) > 1 else ""


def imports_of(path: Path) -> set[str]:
    """Return the parts that a file imports at any time, without imports that only annotations need."""
    imported: set[str] = set()
    todo: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
            # The statement `from impact_posture import tsid` also imports a part.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            imported |= {part_of(name) for name in ([node.module or ""] if "." in (node.module or "") else names)}
        todo += ast.iter_child_nodes(node)
    return imported - {""}


def parts() -> dict[str, tuple[int, int, set[str]]]:
    """Return the number of files, the number of lines, and the imports of each part.  The largest part comes
    first."""
    counts: dict[str, tuple[int, int, set[str]]] = {}
    for package, folder in PACKAGES.items():
        for path in sorted(p for p in folder.rglob("*") if p.suffix in SUFFIXES):
            inner = path.relative_to(folder)
            name = "cli" if package.endswith("cli") else inner.parts[0].removesuffix(".py")
            if name == "__init__":
                continue
            files, lines, imports = counts.get(name, (0, 0, set()))
            more = imports_of(path) if path.suffix == ".py" else set()
            counts[name] = files + 1, lines + len(path.read_text(encoding="utf-8").splitlines()), imports | more
    return dict(sorted(counts.items(), key=lambda item: -item[1][1]))


def markdown() -> str:
    """Return a table with a row for each part, and a row for the sum."""
    every = parts()
    rows = ["| part | files | lines | imports |", "|---|---|---|---|"]
    for name, (files, lines, imports) in every.items():
        others = ", ".join(f"`{other}`" for other in every if other in imports and other != name)
        rows.append(f"| `{name}` | {files} | {lines} | {others} |")
    files, lines = (sum(value[k] for value in every.values()) for k in (0, 1))
    rows.append(f"| together | {files} | {lines} | |")
    return "\n".join(rows)


def module_map() -> str:
    """Return a table for each folder, with the first sentence of each module docstring."""
    folders: dict[Path, list[Path]] = {}
    for path in sorted(p for folder in PACKAGES.values() for p in folder.rglob("*.py") if p.name != "__init__.py"):
        folders.setdefault(path.parent, []).append(path)
    parts = []
    for folder, paths in sorted(folders.items()):
        parts += [f"### `{folder.relative_to(ROOT)}/`", "", "| module | content |", "|---|---|"]
        for path in paths:
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            paragraph = " ".join(text.split("\n\n")[0].split())
            sentence = re.split(r"(?<=\.) +(?=[A-Z])", paragraph)[0].replace("``", "`").replace("|", "\\|")
            parts.append(f"| `{path.name}` | {re.sub(':[a-z]+:', '', sentence)} |")
        parts.append("")
    return "\n".join(parts)


def setup(app: Sphinx) -> dict[str, Any]:
    add_directive(app, "module-map", lambda _: module_map())
    return add_directive(app, "package-structure", lambda _: markdown())
