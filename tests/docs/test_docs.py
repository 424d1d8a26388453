"""Documentation: every shown command runs and prints the output on the page.  ``make docs`` builds the site."""

from __future__ import annotations

import importlib
import json
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
import typer.main

import impact_posture
from impact_posture_cli.app import app
from tests.support.command import run

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if not {"generated", "_build"} & set(p.parts))]

_BLOCK = re.compile(r"^```console\n(.*?)^```", re.MULTILINE | re.DOTALL)
_PROMPT = "$ impact-posture "
_EXIT = re.compile(r"\s+# exit (\d+)\s*$")
_EXAMPLE = re.compile(r"[\w./-]*examples/[\w./-]+")


@dataclass(frozen=True)
class Shown:
    """Command on a page: its arguments, its exit code, and the output lines that the page shows."""

    arguments: tuple[str, ...]
    code: int
    output: tuple[str, ...]


def shown_commands(page: Path) -> list[Shown]:
    """Return the commands in the ``console`` blocks of a page, in order of appearance."""
    commands: list[Shown] = []
    for block in _BLOCK.findall(page.read_text(encoding="utf-8")):
        current: Shown | None = None
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("$"):
                current = None
                if line.startswith(_PROMPT):
                    stated = _EXIT.search(line)
                    words = shlex.split(_EXIT.sub("", line))[2:]
                    current = Shown(tuple(words), int(stated[1]) if stated else 0, ())
                    commands.append(current)
            elif current is not None and line.strip():
                current = Shown(current.arguments, current.code, (*current.output, line))
                commands[-1] = current
    return commands


def example_files(page: Path) -> Iterator[Path]:
    """Yield the files of ``docs/examples`` that a page shows or offers for download."""
    for text in dict.fromkeys(_EXAMPLE.findall(page.read_text(encoding="utf-8"))):
        path = (page.parent / text).resolve()
        if path.is_file() and path.is_relative_to(DOCS / "examples"):
            yield from sorted(p for p in path.parent.iterdir() if p.is_file())


def squeezed(text: str) -> str:
    return " ".join(text.split())


@dataclass(frozen=True)
class Ran:
    """A command shown on a page, with its actual exit code and output."""

    shown: Shown
    code: int
    printed: str
    errors: str

    def __str__(self) -> str:
        return f"impact-posture {shlex.join(self.shown.arguments)}\n{self.printed}\n{self.errors}"


def shortened(page: Path, shown: Shown) -> tuple[str, ...]:
    """Return the arguments of a command, for ``optimize`` with one start unless the page states its outcome."""
    out = [value for option, value in pairwise(shown.arguments) if option == "--out"]
    stated = shown.code or shown.output or set(out) & {result for result, *_ in CLAIMS.get(page.stem, ())}
    if shown.arguments[0] != "optimize" or stated:
        return shown.arguments
    return (*shown.arguments, "--starts", "1")


def run_page(page: Path, folder: Path, long: bool = True) -> Iterator[Ran]:
    """Run the commands of a page one after the other in a folder; without ``long``, shorten them."""
    for file in dict.fromkeys(example_files(page)):
        shutil.copy(file, folder / file.name)
    for sweep in folder.glob("press.toml"):
        # A coarse grid is enough to run the commands of the page.
        sweep.write_text(re.sub("count = [57]", "count = 3", sweep.read_text(encoding="utf-8")), encoding="utf-8")
    for shown in shown_commands(page):
        arguments = shown.arguments if long else shortened(page, shown)
        done = run(*arguments, cwd=folder, env={"COLUMNS": "300"})
        yield Ran(shown, done.returncode, done.stdout, done.stderr)


@pytest.mark.parametrize("page", [p for p in PAGES if p.is_file() and shown_commands(p)], ids=lambda p: p.stem)
def test_shown_commands_run(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    long = request.config.getoption("--long")
    if not long:
        request.getfixturevalue("few_tries")
    for ran in run_page(page, tmp_path, long):
        assert ran.code == ran.shown.code, f"{page.name}: exit code {ran.code}, not {ran.shown.code}: {ran}"
        assert "Traceback" not in ran.errors, f"{page.name}: {ran}"
        if "--json" in ran.shown.arguments:
            json.loads(ran.printed)
        printed = squeezed(ran.printed + " " + ran.errors)
        for line in ran.shown.output:
            assert squeezed(line) in printed, f"{page.name} shows '{line.strip()}', which is not printed: {ran}"
    for result, falls, rises in CLAIMS.get(page.stem, ()):
        document = json.loads((tmp_path / result / "result.json").read_text(encoding="utf-8"))
        change = {k: document["optimal"][k] / document["initial"][k] for k in "HGVS"}
        assert all(change[k] < 0.99 for k in falls), f"{page.name}: {result} {change}"
        assert all(change[k] > 1.01 for k in rises), f"{page.name}: {result} {change}"


# Claims of the tutorials: result folder, quantities that decrease, quantities that increase.
CLAIMS: dict[str, list[tuple[str, str, str]]] = {
    "aerial": [("floor", "HVS", "G"), ("wall", "HV", "S"), ("wall-sticking", "S", "")],
    "arm": [("box", "HG", "VS")],
    # For the hand, rounding decides which optimum the search reaches, so V varies.
    "humanoid": [("hand", "H", "S")],
}


def test_claims_are_about_results_of_shown_commands() -> None:
    for stem, claims in CLAIMS.items():
        page = next(p for p in PAGES if p.stem == stem)
        commands = [s.arguments for s in shown_commands(page) if "--out" in s.arguments]
        assert {c[0] for c in claims} <= {a[a.index("--out") + 1] for a in commands}, stem


def test_commands_are_shown_at_all() -> None:
    """Each tutorial shows commands, and each command of the app is shown in a tutorial."""
    tutorials = [p for p in PAGES if p.parent.name == "tutorials"]
    assert len(tutorials) >= 5
    assert all(shown_commands(p) for p in tutorials)
    used = {s.arguments[0] for p in PAGES for s in shown_commands(p)}
    assert used == set(typer.main.get_command(app).commands), "commands of the app that no page shows, or the reverse"


def test_no_command_escapes_the_convention() -> None:
    """Commands outside ``console`` blocks, or after other prompts, would not be tested."""
    fence = re.compile(r"^```(\{?[\w-]*\}?)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
    for page in PAGES:
        for kind, body in fence.findall(page.read_text(encoding="utf-8")):
            for line in body.splitlines():
                if kind != "console" and re.match(r"\s*[$>%]\s*impact-posture\b", line):
                    pytest.fail(f"{page.name}: '{line.strip()}' stands in a block '{kind}': make it console")
                if kind in ("bash", "sh", "shell"):
                    assert not line.strip().startswith("impact-posture "), f"{page.name}: '{line}': make it console"


def test_every_module_has_its_api_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    markdown = importlib.import_module("api_reference").markdown
    shown: set[str] = set()
    for page in (DOCS / "api").glob("*.md"):
        for names in re.findall(r"^```{api-reference} (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE):
            shown |= set(re.findall(r"automodule:: (\S+)", markdown(names.split())))
    package = Path(impact_posture.__path__[0])
    files = {p.relative_to(package.parent).with_suffix("") for p in package.rglob("*.py")}
    modules = {".".join(p.parts) for p in files if not p.name.startswith("_")}
    assert modules <= shown, f"no API page: {sorted(modules - shown)}"
