"""Rules for files that linters do not check.

Files are short and have unique names, and folders contain few files.  No line contains an absolute path that exists
on one machine only.  Errors of the library do not mention command line options.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

import impact_posture
import impact_posture_cli

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("impact_posture", "cli", "robots", "docs", "tests")
SUFFIXES = {".py", ".toml", ".md", ".urdf", ".srdf", ".json", ".yaml", ".txt", ".c", ".h", ".in"}
MACHINE = re.compile(r"(?<![\w.:/$~}])/(?:home|root|work|tmp|Users|opt|mnt|usr/(?!bin/env))(?=/[\w.])|[A-Z]:\\\\")


def texts() -> list[Path]:
    paths = [*ROOT.glob("*"), *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*"))]
    return [p for p in paths if p.suffix in SUFFIXES and p.is_file() and "_build" not in p.parts]


def modules() -> list[Path]:
    return [p for package in (impact_posture, impact_posture_cli) for p in Path(package.__path__[0]).rglob("*.py")]


def test_files_are_short() -> None:
    long = [p for p in modules() if len(p.read_text(encoding="utf-8").splitlines()) >= 500]
    assert modules() and not long


def test_a_name_says_which_file_or_class_is_meant() -> None:
    files = Counter(path.name for path in modules() if path.name != "__init__.py")
    # Public names such as ``ip.ImpactObjective`` also have only one definition.
    classes = Counter(
        node.name
        for path in modules()
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in (files + classes).items() if count > 1] == []


def test_no_folder_is_crowded() -> None:
    library = Path(impact_posture.__path__[0])
    assert {p.name for p in library.glob("*.py")} == {"__init__.py", "__main__.py", "errors.py", "version.py"}
    assert len([p for p in (ROOT / "tests").iterdir() if not p.name.startswith("__pycache__")]) <= 30


@pytest.mark.skipif(not (ROOT / "docs").is_dir(), reason="not in a checkout")
def test_the_index_of_the_code_names_files_that_exist() -> None:
    page = (ROOT / "docs" / "developer.md").read_text(encoding="utf-8")
    named = {Path(name) for name in re.findall(r"`([\w/.]+\.(?:py|c|css|js|jinja))`", page)}
    known = [path for folder in ("impact_posture", "cli", "tests", "docs") for path in (ROOT / folder).rglob("*.*")]
    assert len(named) > 100
    assert [str(name) for name in named if not any(p.parts[-len(name.parts) :] == name.parts for p in known)] == []


def test_no_path_of_one_machine() -> None:
    this_file = Path(__file__).resolve()
    lines = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in texts()
        if path != this_file
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if MACHINE.search(line)
    ]
    assert not lines, "\n".join(lines)


def test_the_pattern_of_machine_paths() -> None:
    for bad in ("x = '/home/someone/a.urdf'", "see /tmp/scratch/a", r"C:\\Users", "'/root/.ssh/k'"):
        assert MACHINE.search(bad), bad
    for good in ("https://a.b/home/x", "m/s, N·m/work", "robots/tmp/x", "$ROOT/opt/x"):
        assert not MACHINE.search(good), good


def test_errors_of_the_library_name_parameters_and_no_options() -> None:
    """Only the command line translates parameter names into options (``as_options``)."""
    messages = [
        f"{path.name}:{text.lineno}: {text.value}"
        for path in Path(impact_posture.__path__[0]).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Raise)
        for text in ast.walk(node)
        if isinstance(text, ast.Constant) and isinstance(text.value, str) and re.search(r"--[a-z]", text.value)
    ]
    assert not messages, "\n".join(messages)
