"""Robots without a robot.toml on the command line: hints, warnings, locked joints, and drafted files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import typer.main

from impact_posture.config.problem_settings import ImpactSettings, LoadOptions
from impact_posture.errors import FrameNotFound, InertiaError, JointNotFound, not_one_of
from impact_posture.impact.resolved_impact import resolve
from impact_posture.posture.formulation.problem_file import prepare, resolved_settings
from impact_posture.posture.search.impact_notes import percent
from impact_posture.robot.robot_loader import load_robot
from impact_posture_cli.app import app
from impact_posture_cli.argv import put_right
from impact_posture_cli.error_boundary import run
from tests.support.helpers import robot
from tests.support.settings import make_settings

DATA = "example-robot-data:"
B1_Z1 = f"{DATA}b1_description/urdf/b1-z1.urdf"
SRDF = f"{DATA}b1_description/srdf/b1-z1.srdf"
ROMEO = f"{DATA}romeo_description/urdf/romeo.urdf"
UP = ("--normal", "0", "0", "1")


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Run the command line without a new process; return exit code, standard output and standard error."""
    code = run(typer.main.get_command(app), put_right(arguments))
    return code, *capsys.readouterr()


# ---- balance of floating robots ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "frame", "words"),
    [
        ("b1_description/urdf/b1-z1.urdf", "link06", "--support FL_foot --support FR_foot --support RL_foot"),
        ("g1_description/urdf/g1_29dof_rev_1_0.urdf", "right_rubber_hand", "--support left_ankle_roll_link"),
        ("panda_description/urdf/panda.urdf", "panda_hand", "--support FRAME for each foot"),
    ],
)
def test_a_floating_robot_without_feet_or_rotors_needs_a_support(
    path: str, frame: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--root", "free-flyer", "--frame", frame, *UP)
    code, _, errors = call(capsys, "optimize", DATA + path, *asked)
    assert code == 1 and errors.count("\n") == 1
    for word in (words, "--no-support", "--base", "robot.toml", "--write-robot-toml"):
        assert word in errors
    # The command `evaluate` only prints a warning.
    code, _, errors = call(capsys, "evaluate", DATA + path, *asked)
    assert code == 0
    assert any("floating freely" in line and words in line for line in errors.splitlines())


@pytest.mark.parametrize("more", [{"support": ()}, {"support": ("FL_foot",)}, {"base": "level"}])
def test_a_stated_support_needs_no_hint(more: dict[str, Any]) -> None:
    settings = {"robot": B1_Z1, "root": "free-flyer", "frame": "link06", "normal": (0, 0, 1), **more}
    prepared = prepare(make_settings(settings))
    assert not any("floating freely" in line for line in prepared.impact.warnings)
    # The resolved settings also name the support, so the resolved problem can be prepared again.
    prepare(resolved_settings(prepared))


def test_known_robots_need_no_hint() -> None:
    for name in ("borinot", "tilthex_arm", "solo8", "panda"):
        impact = resolve(ImpactSettings(robot=name, normal=(0, 0, 1)))
        assert not any("floating freely" in line for line in impact.warnings), name


# ---- massless joints, patterns ----------------------------------------------------------------------------------


def test_massless_joints_are_listed_and_locked_together(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InertiaError, match="24 joints move no mass") as caught:
        load_robot(ROMEO)
    assert "`lock_massless`" in caught.value.line
    loaded = load_robot(ROMEO, LoadOptions(lock_massless=True))
    assert len(loaded.locked) == 24
    assert all(f"'{joint}'" in caught.value.line for joint in loaded.locked)
    code, out, _ = call(capsys, "inspect", ROMEO, "--lock-massless", "--json")
    assert code == 0 and json.loads(out)["locked"] == list(loaded.locked)
    settings = {"robot": ROMEO, "lock_massless": True, "frame": "r_gripper", "normal": (1, 0, 0)}
    again = resolved_settings(prepare(make_settings(settings)))
    assert again.lock_massless


def test_a_robot_toml_can_lock_them(tmp_path: Path) -> None:
    config = tmp_path / "romeo.toml"
    config.write_text('[model]\nlock_massless = true\nlock = ["Neck*", "HeadRoll"]\n', encoding="utf-8")
    loaded = load_robot(ROMEO, LoadOptions(config=str(config)))
    assert {"NeckYaw", "NeckPitch", "HeadRoll", "LHand"} <= set(loaded.locked)


@pytest.mark.parametrize(
    ("name", "pattern", "count"),
    [("panda", "panda_finger*", 2), ("talos", "arm_*_[12]_joint", 4), ("solo8", "?L_KFE", 2)],
)
def test_lock_takes_patterns(name: str, pattern: str, count: int) -> None:
    locked = load_robot(name, LoadOptions(lock=(pattern,)))
    assert locked.nv == robot(name).nv - count and len(set(locked.locked) - set(robot(name).locked)) == count


def test_a_pattern_that_nothing_fits_is_refused() -> None:
    with pytest.raises(JointNotFound, match=r"no joint 'panda_fang\*'.*nothing fits this pattern"):
        load_robot("panda", LoadOptions(lock=("panda_fang*",)))


# ---- files and bases --------------------------------------------------------------------------------------------


def test_an_srdf_in_the_data_package() -> None:
    load = {"robot": B1_Z1, "srdf": SRDF, "root": "free-flyer", "frame": "link06", "normal": (0, 0, 1), "support": ()}
    prepared = prepare(make_settings(load))
    assert prepared.impact.robot.default_posture == "standing_with_arm_home"
    # The name of the SRDF must not become a path on this machine.
    assert resolved_settings(prepared).srdf == SRDF


@pytest.mark.parametrize(
    ("name", "options", "posture"),
    [
        (B1_Z1, LoadOptions(srdf=SRDF), "standing_with_arm_home"),
        ("solo8", LoadOptions(root="fixed"), "standing"),
        ("talos", LoadOptions(root="fixed"), "half_sitting"),
    ],
)
def test_a_fixed_root_warns_that_it_leaves_out_the_base(name: str, options: LoadOptions, posture: str) -> None:
    warned = [line for line in load_robot(name, options).warnings if "the root is fixed" in line]
    assert len(warned) == 1 and posture in warned[0] and "`root` free-flyer" in warned[0]


def test_a_robot_without_a_base_pose_is_not_warned_about_one() -> None:
    assert not any("the root is fixed" in line for name in ("panda", "solo8") for line in robot(name).warnings)


# ---- words ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.5, "50.0%"), (0.0, "0.0%"), (-1e-9, "0.0%"), (1.0, "100.0%"), (1 - 0.18 / 389.8, "99.95%"),
        (1 - 1e-9, "99.9999999%"), (-0.25, "-25.0%"), (1 - 2**-53, "99.99999999999999%"), (1.5, "150.0%"),
    ],
)  # fmt: skip
def test_percent_never_rounds_to_100(share: float, text: str) -> None:
    assert percent(share) == text


@pytest.mark.parametrize(
    ("command", "option", "value", "words"),
    [
        ("evaluate", "--metric", "kinetik", "; ".join(not_one_of("kinetik", ("euclidean", "kinetic", "weighted")))),
        ("evaluate", "--root", "free", "did you mean free-flyer?"),
        ("optimize", "--format", "gif", "'gif' is not one of png, svg, pdf; choose one of them"),
        ("optimize", "--contact-pose", "positon", "did you mean position?"),
        ("optimize", "--compile", "maybe", "is not one of auto, always, never"),
    ],
)
def test_a_misspelt_value_gets_a_suggestion(
    command: str, option: str, value: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, errors = call(capsys, command, "panda", *UP, option, value)
    assert code == 2
    assert words in " ".join(errors.split()) and "Value error" not in errors


def test_a_misspelt_value_of_a_file_gets_the_same_suggestion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "p.toml"
    path.write_text('robot = "panda"\nnormal = [0, 0, 1]\nmetric = "kinetik"\n')
    code, _, errors = call(capsys, "optimize", str(path))
    words = "; ".join(not_one_of("kinetik", ("euclidean", "kinetic", "weighted")))
    assert code == 1 and f"key 'metric': {words}" in errors


@pytest.mark.parametrize(("name", "first"), [("panda", "panda_hand_tcp"), (B1_Z1, "gripperStator")])
def test_frames_that_are_suggested_are_tips_first(name: str, first: str) -> None:
    with pytest.raises(FrameNotFound) as caught:
        resolve(ImpactSettings(robot=name, frame="§", normal=(0, 0, 1)))
    assert caught.value.nearest[0] == first


def test_a_robot_of_the_data_package_is_named_by_its_uri(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, errors = call(capsys, "inspect", "b1-z1")
    assert code == 1 and B1_Z1 in errors


def test_inspect_drafts_a_robot_toml(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, _ = call(capsys, "inspect", B1_Z1, "--write-robot-toml")
    assert code == 0 and "written: b1-z1.toml" in out and "--config b1-z1.toml" in out
    assert call(capsys, "inspect", B1_Z1, "--config", "b1-z1.toml")[0] == 0
    code, _, errors = call(capsys, "inspect", B1_Z1, "--write-robot-toml", "b1-z1.toml")
    assert code == 1 and "b1-z1.toml: exists" in errors
    code, out, _ = call(capsys, "inspect", "--write-robot-toml", B1_Z1, "--force", "--json")
    document = json.loads(out)
    assert document["text"] == (tmp_path / "b1-z1.toml").read_text() and document["guesses"]
    code, _, errors = call(capsys, "inspect", B1_Z1, "--config", "b1-z1.toml", "--write-robot-toml")
    assert code == 2 and "--config contradicts" in errors
