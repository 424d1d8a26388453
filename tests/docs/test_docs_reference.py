"""Reference pages: every key and option has a table row with its default, and every row has a key or option."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from impact_posture.config.problem_settings import ContactPose, ProblemSettings
from impact_posture.posture.analysis.pareto_front import pareto_front
from impact_posture.posture.analysis.result_document import result_document
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.certificate import Certificate
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot_spec import RobotSpec
from impact_posture.simulation.controllers.controller_factory import CONTROLLERS
from impact_posture.simulation.scenario_file import ScenarioTable
from impact_posture_cli.app import COMMANDS, build
from tests.support.settings import make_settings

DOCS = Path(__file__).parents[2] / "docs"


def rows(page: Path) -> dict[str, list[str]]:
    """Map the code in the first cell of each table row to the other cells of the row."""
    cells_of: dict[str, list[str]] = {}
    for line in page.read_text(encoding="utf-8").splitlines():
        if not line.startswith("| `"):
            continue
        cells = [c.strip() for c in re.split(r"(?<!\\)\|", line.strip().strip("|"))]
        for key in re.findall(r"`([^`]+)`", cells[0]):
            assert key not in cells_of, f"{page.name} has two rows for '{key}'"
            cells_of[key] = cells[1:]
    return cells_of


def nested(annotation: object) -> type | None:
    """Return the dataclass that a type such as ``Table``, ``Table | None`` or ``tuple[Table, ...]`` contains."""
    if inspect.isclass(annotation) and is_dataclass(annotation):
        return annotation
    return next((m for a in getattr(annotation, "__args__", ()) if (m := nested(a)) is not None), None)


def keys(table: type, prefix: str = "") -> dict[str, object]:
    """Map the dotted keys of a dataclass to their defaults; a required key maps to ``...``."""
    defaults: dict[str, object] = {}
    hints = get_type_hints(table)
    for key in fields(table):
        inner = nested(hints[key.name])
        default = key.default if key.default_factory is MISSING else key.default_factory()
        if inner is not None:
            named = str(hints[key.name]).startswith("dict")
            defaults |= keys(inner, f"{prefix}{key.name}.NAME." if named else f"{prefix}{key.name}.")
        else:
            defaults[prefix + key.name] = ... if default is MISSING else default
    return defaults


def shown_default(value: object) -> str:
    """Write a default value in the notation of the pages."""
    if value is ... or value is None:
        return "required" if value is ... else "none"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{json.dumps(value)}`"


@pytest.mark.parametrize(("page", "table"), [("robot-toml.md", RobotSpec), ("scenario-toml.md", ScenarioTable)])
def test_every_key_has_its_row(page: str, table: type) -> None:
    expected = keys(table)
    assert {"schema", "name"} <= set(expected) and any(key.count(".") == 2 for key in expected)
    # Rows of other tables contain names of poses instead of keys.
    shown = {key: cells for key, cells in rows(DOCS / "reference" / page).items() if key not in get_args(ContactPose)}
    assert set(shown) == set(expected)
    for key, value in expected.items():
        assert shown[key][1] == shown_default(value), f"default of {key}"
        assert len(shown[key][2]) > 3, f"{key} is not explained"


def test_contact_poses_are_explained() -> None:
    for page in (DOCS / "reference" / "robot-toml.md", DOCS / "tutorials" / "arm.md"):
        assert set(get_args(ContactPose)) <= set(rows(page)), page.name


def test_every_problem_toml_key_has_its_row() -> None:
    expected = keys(ProblemSettings)
    cells = rows(DOCS / "reference" / "problem-toml.md")
    assert set(cells) == set(expected)
    for key, value in expected.items():
        shown = cells[key][1]
        # For the default None, the page describes the effect in words, such as "from the robot".
        if value is None:
            assert not shown.startswith("`"), f"default of {key}"
        elif key != "normal":
            assert shown == shown_default(value), f"default of {key}"


def test_every_option_is_in_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference is generated from signatures, so it must agree with Typer's parser."""
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    reference = importlib.import_module("cli_reference").markdown()
    sections = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", reference, re.MULTILINE | re.DOTALL))
    commands = {name: build(name) for name in COMMANDS}
    assert list(sections) == list(commands)
    for name, command in commands.items():
        table = [line for line in sections[name].splitlines() if line.startswith("| `-")]
        shown = {word for line in table for word in re.findall(r"(?<![\w-])--?[a-z][a-z-]*", line.split("` |")[0])}
        taken = {o for p in command.params for o in (*p.opts, *p.secondary_opts) if o.startswith("-")}
        assert shown == taken - {"--help"}, name
        assert all(len(line.split(" | ")[-1].strip(" |")) > 5 for line in table), f"{name}: an option without help"


def test_every_problem_key_is_an_option() -> None:
    command = build("optimize")
    names = {o[2:].replace("-", "_") for p in command.params for o in p.opts if o.startswith("--")}
    names |= {"schema", "robot"}
    # For keys without an option, the page says so, or the tool itself writes the key.
    without = {key.partition(".")[0] for key in set(keys(ProblemSettings)) - names}
    assert without == {"q", "support_compliance", "mounting", "obstacles"}


def test_result_keys_have_their_rows() -> None:
    prepared = prepare(make_settings({"robot": "solo8", "normal": (1, 0, 0), "starts": 1}))
    document = result_document(prepared, solve(prepared.problem, starts=1, jobs=1, compile="never"))
    shown = set(rows(DOCS / "reference" / "result-json.md"))
    for key, value in document.items():
        if key in ("initial", "optimal"):
            assert isinstance(value, dict)
            for inner, content in value.items():
                parts = content if isinstance(content, dict) and inner in ("ellipsoid", "pose") else {None: None}
                for part in parts:
                    name = inner if part is None else f"{inner}.{part}"
                    assert {name, f"{key}.{name}"} & shown, f"no row for {key}.{name}"
        elif isinstance(value, dict) and key in ("robot", "metric", "solver"):
            assert not {f"{key}.{inner}" for inner in value} - shown
        else:
            assert key in shown, f"no row for {key}"


def test_tradeoff_keys_are_in_their_row() -> None:
    solution = solve(prepare(make_settings({"robot": "panda", "normal": (0, 0, 1)})).problem, starts=1, jobs=1)
    (row,) = rows(DOCS / "reference" / "result-json.md")["tradeoff"]
    for key in pareto_front(solution, 1).to_list()[0]:
        assert f"`{key}`" in row, key


def test_the_theory_page_states_the_tolerances_of_the_certificate() -> None:
    section = (DOCS / "theory.md").read_text(encoding="utf-8").split("## The certificate", 1)[1].split("\n## ", 1)[0]
    shown = dict(re.findall(r"^\| `(\w+)`.*\| \$10\^\{(-\d+)\}\$ \|$", section, re.MULTILINE))
    for name, parameter in inspect.signature(Certificate.holds).parameters.items():
        if name != "self":
            assert float(f"1e{shown['pose_error_m' if name == 'pose' else name]}") == parameter.default, name


def test_every_controller_is_in_the_help_and_on_the_page() -> None:
    option = next(p for p in build("simulate").params if p.name == "controller")
    named = set(re.findall(r"[a-z-]+", str(getattr(option, "help", ""))))
    page = set(re.findall(r"^\| `([a-z-]+)` \|", (DOCS / "experiments.md").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(CONTROLLERS) <= named & page
