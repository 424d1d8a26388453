"""The settings of a problem are the same on the command line, in problem.toml and in Python."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.errors import SpecError
from impact_posture.posture.formulation.problem_file import dump_settings, prepare, read_settings, resolved_settings
from impact_posture_cli.app import build
from impact_posture_cli.output import as_options
from impact_posture_cli.settings_options import settings_of
from tests.support.command import run

# Keys of problem.toml that have no command line option.
NO_OPTION = {"robot", "schema", "q", "support_compliance", "mounting", "obstacles"}


def test_every_setting_is_an_option_of_optimize_with_a_help_text() -> None:
    options = {parameter.name for parameter in build("optimize").params}
    assert {field.name for field in fields(ProblemSettings)} - NO_OPTION <= options
    assert all(8 < len(setting.help) < 100 for setting in settings_of(ProblemSettings).values())


WRONG: list[tuple[str, object, str]] = [
    ("impulse", -1.0, "above zero"),
    ("impulse", float("nan"), "above zero"),
    ("speed", -0.1, "zero or more"),
    ("restitution", 1.5, "from 0 to 1"),
    ("normal", (0.0, 0.0, 0.0), "not all zero"),
    ("normal", (0.0, float("inf"), 0.0), "not all zero"),
    ("offset", (0.0, float("nan"), 0.0), "finite"),
    ("normal_cone", 90.0, "below 90"),
    ("target_quaternion", (0.0, 0.0, 0.0, 2.0), "norm 2; give a unit quaternion"),
    ("armature_range", (2.0, 0.5), "the lower first"),
    ("box", (0.1, 0.0, 0.1), "above zero"),
    ("friction", -0.1, "zero or more"),
    ("starts", 0, "1 or more"),
    ("seed", -1, "zero or more"),
    ("tradeoff", -1, "zero or more"),
]


@pytest.mark.parametrize(("name", "value", "words"), WRONG)
def test_a_wrong_value_meets_the_same_demand_everywhere(name: str, value: Any, words: str, tmp_path: Path) -> None:
    table = {"robot": "tilthex_arm", "normal": (0, 0, 1)} | {name: value}
    with pytest.raises(SpecError, match=words):
        validate(ProblemSettings, table, "Python")
    lines = [f"{key} = {list(v) if isinstance(v, tuple) else v!r}" for key, v in table.items()]
    path = tmp_path / "p.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(SpecError, match=words) as caught:
        read_settings(path)
    assert f"'{name}'" in caught.value.line
    words_of = [str(v) for v in value] if isinstance(value, tuple) else [str(value)]
    option = f"--{name.replace('_', '-')}"
    normal = () if name == "normal" else ("--normal", 0, 0, 1)
    done = run("optimize", "tilthex_arm", *normal, option, *words_of, cwd=tmp_path)
    assert done.returncode == 2 and option in done.stderr and words in " ".join(done.stderr.split())


@pytest.mark.parametrize("value", ["1.0", True])
def test_a_value_of_another_type_is_refused(value: object) -> None:
    with pytest.raises(SpecError, match="key 'impulse'"):
        validate(ProblemSettings, {"robot": "panda", "impulse": value}, "Python")


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"metric": "weighted", "weights": "velocity-limits", "objective": "sticking"},
        {"armature_range": (1.0, 2.0), "payload": (("ee", 0.5),)},
        {"armature_range": (3.0, 4.0), "objective": "speed"},
        {"contact": ("ee:0,0,1", "base_link:1,0,0:2"), "bilateral": True},
        {"normal_cone": 5.0, "normal_frame": "contact", "speed": 0.5, "restitution": 0.25},
    ],
    ids=lambda more: "-".join(more) or "plain",
)
def test_resolved_settings_are_the_same_problem(more: dict[str, object], tmp_path: Path) -> None:
    name = "ur5" if more.get("metric") == "weighted" else "tilthex_arm"
    frame = {} if "contact" in more else {"frame": "tool0" if name == "ur5" else "ee", "normal": (0.3, 0.0, 2.0)}
    first = prepare(validate(ProblemSettings, {"robot": name, **frame, **more}, "test"))
    path = tmp_path / "problem.toml"
    # Some editors write a byte-order mark at the beginning of a file.
    path.write_text(dump_settings(resolved_settings(first)), encoding="utf-8-sig" if more else "utf-8")
    again = prepare(read_settings(path))
    assert again.impact.to_dict() == first.impact.to_dict()
    assert again.problem.requirements == replace(first.problem.requirements, com_asked=True, approach_asked=True)
    q = first.impact.robot.posture()
    assert again.problem.objective.value(q) == first.problem.objective.value(q)


def test_parameters_in_messages_are_printed_as_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture_cli.output._OPTIONS", set())
    assert as_options("give `support` a, no `support`, or `normal_cone` 0") == (
        "give --support a, --no-support, or --normal-cone 0"
    )
    monkeypatch.setattr("impact_posture_cli.output._OPTIONS", {"--out"})
    assert as_options("give `out` or `speed`") == "give --out or 'speed'"
    assert as_options("run optimize again with `path`") == "run optimize again with --path"
