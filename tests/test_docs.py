"""The documentation: every command that it shows runs as it says, and the site builds."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer.main

from impact_posture_cli.app import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if not {"generated", "_build"} & set(p.parts))]

_BLOCK = re.compile(r"^```console\n(.*?)^```", re.MULTILINE | re.DOTALL)
_PROMPT = "$ impact-posture "
_EXIT = re.compile(r"\s+# exit (\d+)\s*$")
_EXAMPLE = re.compile(r"[\w./-]*examples/[\w./-]+")


@dataclass(frozen=True)
class Shown:
    """A command of a page: its arguments, exit code, and output lines that the page shows."""

    arguments: tuple[str, ...]
    code: int
    output: tuple[str, ...]


def shown_commands(page: Path) -> list[Shown]:
    """The commands of a page's ``console`` blocks, in order."""
    found: list[Shown] = []
    for block in _BLOCK.findall(page.read_text(encoding="utf-8")):
        current: Shown | None = None
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("$"):
                current = None
                if line.startswith(_PROMPT):
                    stated = _EXIT.search(line)
                    words = shlex.split(_EXIT.sub("", line))[2:]
                    current = Shown(tuple(words), int(stated[1]) if stated else 0, ())
                    found.append(current)
            elif current is not None and line.strip():
                current = Shown(current.arguments, current.code, (*current.output, line))
                found[-1] = current
    return found


def example_files(page: Path) -> Iterator[Path]:
    """Files of ``docs/examples`` that a page shows or offers."""
    for text in dict.fromkeys(_EXAMPLE.findall(page.read_text(encoding="utf-8"))):
        path = (page.parent / text).resolve()
        if path.is_file() and path.is_relative_to(DOCS / "examples"):
            yield from sorted(p for p in path.parent.iterdir() if p.is_file())


def squeezed(text: str) -> str:
    return " ".join(text.split())


@dataclass(frozen=True)
class Ran:
    """A shown command, what came of it, and the words for a failure."""

    shown: Shown
    code: int
    printed: str
    errors: str

    def __str__(self) -> str:
        return f"impact-posture {shlex.join(self.shown.arguments)}\n{self.printed}\n{self.errors}"


def run_page(page: Path, folder: Path) -> list[Ran]:
    """Run a page's commands in ``folder``, up to the first that ends otherwise than the page says."""
    program = Path(sys.executable).with_name("impact-posture")
    assert program.is_file(), f"no entry point {program}: install the package first"
    for file in dict.fromkeys(example_files(page)):
        shutil.copy(file, folder / file.name)
    environment = os.environ | {
        "COLUMNS": "300", "OMP_NUM_THREADS": "1", "IMPACT_POSTURE_CACHE": str(folder / ".cache"),
    }  # fmt: skip
    ran: list[Ran] = []
    for shown in shown_commands(page):
        done = subprocess.run(
            [str(program), *shown.arguments],
            cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False,
        )  # fmt: skip
        ran.append(Ran(shown, done.returncode, done.stdout, done.stderr))
        if done.returncode != shown.code:
            break
    return ran


@pytest.fixture(scope="module")
def page_runs(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[Path, tuple[Path, Future[list[Ran]]]]]:
    """The selected pages, two at a time: they wait for their programs, not for Python."""
    items = [item for item in request.session.items if "page_runs" in getattr(item, "fixturenames", ())]
    selected = [item.callspec.params["page"] for item in items]  # type: ignore[attr-defined]
    with ThreadPoolExecutor(2) as pool:
        runs = {}
        for page in dict.fromkeys(selected):
            folder = tmp_path_factory.mktemp(page.stem)
            runs[page] = folder, pool.submit(run_page, page, folder)
        yield runs


@pytest.mark.parametrize("page", [p for p in PAGES if p.is_file() and shown_commands(p)], ids=lambda p: p.stem)
def test_shown_commands_run(page: Path, page_runs: dict[Path, tuple[Path, Future[list[Ran]]]]) -> None:
    folder, future = page_runs[page]
    for ran in future.result():
        assert ran.code == ran.shown.code, f"{page.name}: exit code {ran.code}, not {ran.shown.code}: {ran}"
        assert "Traceback" not in ran.errors, f"{page.name}: {ran}"
        if "--json" in ran.shown.arguments:
            json.loads(ran.printed)
        printed = squeezed(ran.printed + " " + ran.errors)
        for line in ran.shown.output:
            assert squeezed(line) in printed, f"{page.name} shows '{line.strip()}', which is not printed: {ran}"
    for result, falls, rises in CLAIMS.get(page.stem, ()):
        document = json.loads((folder / result / "result.json").read_text(encoding="utf-8"))
        change = {k: document["optimal"][k] / document["initial"][k] for k in "HGVS"}
        assert all(change[k] < 0.99 for k in falls), f"{page.name}: {result} {change}"
        assert all(change[k] > 1.01 for k in rises), f"{page.name}: {result} {change}"


# What the tutorials say of their results in words: result folder, what falls, what rises.
CLAIMS: dict[str, list[tuple[str, str, str]]] = {
    "aerial": [("floor", "HVS", "G"), ("wall", "HV", "S"), ("wall-sticking", "S", "")],
    "arm": [("box", "HG", "V")],
    "humanoid": [("hand", "HV", "S")],
}


def test_claims_are_about_results_of_shown_commands() -> None:
    for stem, claims in CLAIMS.items():
        page = next(p for p in PAGES if p.stem == stem)
        commands = [s.arguments for s in shown_commands(page) if "--out" in s.arguments]
        assert {c[0] for c in claims} <= {a[a.index("--out") + 1] for a in commands}, stem


def test_commands_are_shown_at_all() -> None:
    """The extraction finds what a reader sees: each tutorial has commands, and each command of the app is shown."""
    tutorials = [p for p in PAGES if p.parent.name == "tutorials"]
    assert len(tutorials) >= 5
    assert all(shown_commands(p) for p in tutorials)
    used = {s.arguments[0] for p in PAGES for s in shown_commands(p)}
    assert used == set(typer.main.get_command(app).commands), "commands of the app that no page shows, or the reverse"


def test_no_command_escapes_the_convention() -> None:
    """A command in a block of another kind, or after another prompt, would never be run."""
    fence = re.compile(r"^```(\{?[\w-]*\}?)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
    for page in PAGES:
        for kind, body in fence.findall(page.read_text(encoding="utf-8")):
            for line in body.splitlines():
                if kind != "console" and re.match(r"\s*[$>%]\s*impact-posture\b", line):
                    pytest.fail(f"{page.name}: '{line.strip()}' stands in a block '{kind}': make it console")
                if kind in ("bash", "sh", "shell"):
                    assert not line.strip().startswith("impact-posture "), f"{page.name}: '{line}': make it console"


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="needs the docs extra: pip install 'impact-posture[docs]'")
    pytest.importorskip("furo", reason="needs the docs extra: pip install 'impact-posture[docs]'")
    pytest.importorskip("myst_parser", reason="needs the docs extra: pip install 'impact-posture[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(tmp_path / "html")],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    cli = (tmp_path / "html" / "reference" / "cli.html").read_text(encoding="utf-8")
    assert "--contact-pose" in cli, "the command-line reference is empty"


def test_every_module_has_its_api_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    markdown = importlib.import_module("api_reference").markdown
    shown: set[str] = set()
    for page in (DOCS / "api").glob("*.md"):
        for names in re.findall(r"^```{api-reference} (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE):
            shown |= set(re.findall(r"automodule:: (\S+)", markdown(names.split())))
    files = {p.relative_to(ROOT).with_suffix("") for p in (ROOT / "impact_posture").rglob("*.py")}
    modules = {".".join(p.parts) for p in files if not p.name.startswith("_")}
    assert modules <= shown, f"no API page: {sorted(modules - shown)}"
