"""The reference pages: every key and option that exists has its row, with its default, and no row is stale."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from impact_posture.config.settings import ContactPose, ProblemSettings
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
    """Table rows of a page whose first cell is code: that code to the other cells."""
    found: dict[str, list[str]] = {}
    for line in page.read_text(encoding="utf-8").splitlines():
        if not line.startswith("| `"):
            continue
        cells = [c.strip() for c in re.split(r"(?<!\\)\|", line.strip().strip("|"))]
        for key in re.findall(r"`([^`]+)`", cells[0]):
            assert key not in found, f"{page.name} has two rows for '{key}'"
            found[key] = cells[1:]
    return found


def nested(annotation: object) -> type | None:
    """The dataclass inside ``Table``, ``Table | None``, ``tuple[Table, ...]`` or ``dict[str, Table]``."""
    if inspect.isclass(annotation) and is_dataclass(annotation):
        return annotation
    return next((m for a in getattr(annotation, "__args__", ()) if (m := nested(a)) is not None), None)


def keys(table: type, prefix: str = "") -> dict[str, object]:
    """Dotted keys of a dataclass and their defaults; ``...`` where there is none."""
    found: dict[str, object] = {}
    hints = get_type_hints(table)
    for one in fields(table):
        inner = nested(hints[one.name])
        default = one.default if one.default_factory is MISSING else one.default_factory()
        if inner is not None:
            named = str(hints[one.name]).startswith("dict")
            found |= keys(inner, f"{prefix}{one.name}.NAME." if named else f"{prefix}{one.name}.")
        else:
            found[prefix + one.name] = ... if default is MISSING else default
    return found


def test_keys_are_found_in_nested_models() -> None:
    found = keys(RobotSpec)
    assert {"schema", "model.root", "postures.NAME.base", "supports.kind", "propulsion.rotors.spin"} <= set(found)


def shown_default(value: object) -> str:
    """A default as the pages write it."""
    if value is ...:
        return "required"
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{json.dumps(value)}`"


def test_every_robot_toml_key_has_its_row() -> None:
    expected = keys(RobotSpec)
    found = {
        key: cells for key, cells in rows(DOCS / "reference" / "robot-toml.md").items()
        if "." in key or key in RobotSpec.__dataclass_fields__ or key == "schema"
    }  # fmt: skip
    assert set(found) == set(expected)
    for key, value in expected.items():
        assert found[key][1] == shown_default(value), f"default of {key}"
        assert len(found[key][2]) > 8, f"{key} is not explained"


def test_contact_poses_are_explained() -> None:
    for page in (DOCS / "reference" / "robot-toml.md", DOCS / "tutorials" / "arm.md"):
        assert set(get_args(ContactPose)) <= set(rows(page)), page.name


def test_every_problem_toml_key_has_its_row() -> None:
    expected = keys(ProblemSettings)
    found = rows(DOCS / "reference" / "problem-toml.md")
    assert set(found) == set(expected)
    for key, value in expected.items():
        shown = found[key][1]
        # None means: from the robot, or where it is.  Such a default is said in words.
        if value is None:
            assert not shown.startswith("`"), f"default of {key}"
        elif key != "normal":
            assert shown == shown_default(value), f"default of {key}"


def test_every_scenario_toml_key_has_its_row() -> None:
    expected, found = keys(ScenarioTable), rows(DOCS / "reference" / "scenario-toml.md")
    assert set(found) == set(expected)
    for key, value in expected.items():
        assert found[key][1] == shown_default(value), f"default of {key}"
        assert len(found[key][2]) > 3, f"{key} is not explained"


def test_every_option_is_in_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference reads signatures, the parser is Typer's: what one has the other must have."""
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
    """``problem.toml`` says that each of its keys is an option."""
    command = build("optimize")
    names = {o[2:].replace("-", "_") for p in command.params for o in p.opts if o.startswith("--")}
    names |= {"schema", "robot"}
    # Written by the tool itself: the start as numbers, and the compliance in force.
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


def test_certificate_tolerances_are_those_of_the_theory_page() -> None:
    text = (DOCS / "theory.md").read_text(encoding="utf-8")
    table = {k: v[-1] for k, v in rows_of(text, "## The certificate").items()}
    defaults = {k: p.default for k, p in inspect.signature(Certificate.holds).parameters.items() if k != "self"}
    shown = {"pose": table["pose_error_m"], **{k: table[k] for k in ("stationarity", "primal", "complementarity")}}
    assert {k: power(v) for k, v in shown.items()} == defaults


def rows_of(text: str, heading: str) -> dict[str, list[str]]:
    """First code of each table row below a heading to its other cells."""
    section = text.split(heading, 1)[1].split("\n## ", 1)[0]
    lines = [line for line in section.splitlines() if line.startswith("| `")]
    return {re.findall(r"`([^`]+)`", line)[0]: [c.strip() for c in line.strip("| ").split("|")] for line in lines}


def power(text: str) -> float:
    found = re.fullmatch(r"\$10\^\{(-\d+)\}\$", text)
    assert found, text
    return float(f"1e{found[1]}")


def test_every_controller_is_in_the_help_and_on_the_page() -> None:
    option = next(p for p in build("simulate").params if p.name == "controller")
    named = set(re.findall(r"[a-z-]+", str(getattr(option, "help", ""))))
    page = set(re.findall(r"^\| `([a-z-]+)` \|", (DOCS / "experiments.md").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(CONTROLLERS) <= named & page
