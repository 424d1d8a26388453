"""A folder for attacks, and the count of the inputs that the hostile tests try.

A test counts the inputs that it gives to ``strike``, ``attack`` or ``judging``; a test without these counts as one
input.  A failing test has at least one mishandled input.  ``--hostile-table`` writes the counts into
docs/generated/hostile.md, and keeps the rows of test files that did not run.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from impact_posture.api.posture_problem import PostureProblem
from impact_posture.api.posture_result import PostureResult
from impact_posture.output import plot
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from tests.hostile.arena import SMALL, TALLY, strike
from tests.hostile.disturbed_sweeps import GRID
from tests.support.settings import make_settings

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "hostile.md"
HEAD = "<!-- Written by `make study-hostile`; do not edit. -->"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hostile-table", action="store_true", help=f"write {PAGE.name} from the counts of this run")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    TALLY.tried = TALLY.mishandled = 0
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    if report.failed or (report.passed and report.when == "call"):
        tried, mishandled = (TALLY.tried, TALLY.mishandled) if report.when == "call" else (1, 1)
        about = (item.module.__doc__ or "").partition("\n")[0]
        report.user_properties.append(("hostile", [about, max(1, tried), max(int(report.failed), mishandled)]))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    reports = [report for reports in terminalreporter.stats.values() for report in reports]
    rows = counted([report for report in reports if isinstance(report, pytest.TestReport)])
    if rows:
        terminalreporter.line(f"hostile inputs {table(rows)[-1]}")
    # Workers of pytest-xdist know only their part of the tests.
    if config.getoption("--hostile-table", default=False) and not hasattr(config, "workerinput"):
        before = PAGE.read_text(encoding="utf-8").splitlines() if PAGE.is_file() else []
        cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in before if line.startswith("| ")]
        kept = {name: Row(about, int(tried), int(bad)) for name, about, tried, bad in cells[1:-1]}
        PAGE.write_text("\n".join([HEAD, "", *table(kept | rows), ""]), encoding="utf-8")


@dataclass
class Row:
    """Row of the table: subject of a test file, and its tried and mishandled inputs."""

    about: str
    tried: int = 0
    mishandled: int = 0


def counted(reports: list[pytest.TestReport]) -> dict[str, Row]:
    """Return the row of each test file that ran."""
    rows: dict[str, Row] = {}
    for report in reports:
        name = Path(report.location[0]).stem.removeprefix("test_").replace("_", " ")
        for about, tried, mishandled in (value for key, value in report.user_properties if key == "hostile"):
            row = rows.setdefault(name, Row(about.rstrip(".")))
            row.tried, row.mishandled = row.tried + tried, row.mishandled + mishandled
    return rows


def table(rows: dict[str, Row]) -> list[str]:
    """Return the lines of a table with all rows and their sums."""
    lines = ["| inputs | what is tested | tried | mishandled |", "|---|---|---|---|"]
    lines += [f"| {name} | {row.about} | {row.tried} | {row.mishandled} |" for name, row in sorted(rows.items())]
    tried, mishandled = (sum(getattr(row, key) for row in rows.values()) for key in ("tried", "mishandled"))
    return [*lines, f"| all | | {tried} | {mishandled} |"]


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Check that the small robot can be evaluated, and import all modules once before the forks."""
    import tests.support.command  # noqa: F401

    folder = tmp_path_factory.mktemp("sound")
    (folder / "small.urdf").write_text(SMALL)
    outcome = strike(folder, "evaluate", "small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err


@pytest.fixture
def arena(tmp_path: Path, sound: None) -> Path:
    (tmp_path / "small.urdf").write_text(SMALL)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("ten years")
    (tmp_path / "wrong.json").write_text('{"names": 3, "joints": ["nobody"]}')
    (tmp_path / "wrong.toml").write_text("[[[")
    return tmp_path


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result folder without figures."""
    place = tmp_path_factory.mktemp("result")
    (place / "small.urdf").write_text(SMALL)
    prepared = prepare(make_settings({
        "robot": str(place / "small.urdf"), "frame": "tip", "normal": (1.0, 0.0, 0.0), "contact_pose": "free",
    }))  # fmt: skip
    solution = solve(prepared.problem, starts=1, compile="never")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "draw_all", lambda *_: [])
        result = PostureResult(PostureProblem.of(prepared), solution)
        result.save(place / "out", codegen=False, report=False, jobs=1)
    return place / "out"


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed (the extra 'sweep')")
    (tmp_path / "sweep.toml").write_text(GRID)
    return tmp_path / "sweep.toml"
