"""Commands replace only files that they wrote and that nobody changed later; other files require --force."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest

from impact_posture.errors import OutputError
from impact_posture.sweep.sweep_file import read_sweep
from impact_posture.sweep.sweep_run import run_sweep
from impact_posture.system.output_folder import added_files, check_output, whole_folder
from impact_posture.system.scratch_folder import RECORD
from impact_posture_cli.app import build
from tests.hostile.arena import PUSH, SMALL, SWEEP, judging, strike
from tests.hostile.values import spoiled

# A command, and a file that the command adds to an existing folder.
ADDING = {
    "plot": (("plot", "out", "--figure", "jump", "--format", "svg", "--out", "."), "jump.svg"),
    "report": (("report", "out"), "out/report.html"),
    "sweep show": (("sweep", "show", "press", "--format", "svg"), "press/maps/map-0.svg"),
}
# Commands that write the folder ``precious``, or a file.
WHOLE = {
    "optimize": ("optimize", *PUSH, "--out", "precious"),
    "codegen": ("codegen", *PUSH, "--out", "precious"),
    "controller": ("codegen", *PUSH, "--controller", "arm", "--out", "precious"),
    "simulate": ("simulate", "panda-tap", "--out", "precious"),
    "world": ("simulate", "panda-tap", "--export-world", "precious"),
    "compare": ("compare", "panda-tap", "--out", "precious"),
    "reproduce": ("reproduce", "--out", "precious"),
    "sweep": ("sweep", "sweep.toml", "--out", "precious"),
}


@pytest.fixture(scope="module")
def press(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a sweep of two points."""
    pytest.importorskip("pyarrow")
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "small.urdf").write_text(SMALL)
    (folder / "sweep.toml").write_text(SWEEP)
    run_sweep(read_sweep(folder / "sweep.toml"), folder / "press")
    return folder / "press"


@pytest.mark.parametrize("name", ADDING)
def test_files_of_users_are_only_replaced_by_force(name: str, result: Path, arena: Path, request: Any) -> None:
    argv, file = ADDING[name]
    folder = request.getfixturevalue("press") if name == "sweep show" else result
    shutil.copytree(folder, arena / folder.name)
    path = arena / file
    path.parent.mkdir(exist_ok=True)

    def refused() -> None:
        outcome = strike(arena, *argv)
        assert (outcome.code, outcome.complaints) == (1, []), outcome.err
        assert file in outcome.err and "--force" in outcome.err

    path.write_text("ten years")
    refused()
    # After the first command, the folder has a record of the file.
    for force in (["--force"], []):
        done = strike(arena, *argv, *force)
        assert (done.code, done.complaints) == (0, []), done.err
        assert path.stat().st_size > 1000
    path.write_bytes(path.read_bytes() + b"a note")
    refused()


@pytest.mark.parametrize("name", WHOLE)
def test_folders_of_users_are_never_replaced(name: str, arena: Path) -> None:
    (arena / "sweep.toml").write_text(SWEEP)
    outcome = strike(arena, *WHOLE[name])
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "precious: exists" in outcome.err and "--force" in outcome.err
    outcome = strike(arena, *WHOLE[name], "--force")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "precious: holds thesis.txt" in outcome.err


def test_a_changed_file_is_named(result: Path, arena: Path) -> None:
    shutil.copytree(result, arena / "precious", dirs_exist_ok=True)
    (arena / "precious" / "thesis.txt").unlink()
    first = strike(arena, *WHOLE["optimize"])
    assert "precious: exists; choose" in first.err
    with (arena / "precious" / "problem.toml").open("a") as file:
        file.write("# my note\n")
    outcome = strike(arena, *WHOLE["optimize"])
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "changes of yours in problem.toml" in outcome.err and "--force" in outcome.err


def test_a_sweep_replaces_another_sweep_by_force(press: Path, arena: Path) -> None:
    shutil.copytree(press, arena / "press")
    (arena / "press" / "notes.txt").write_text("ten years")
    (arena / "sweep.toml").write_text(SWEEP.replace("[1, 2]", "[1, 3]"))
    argv = (*WHOLE["sweep"][:-1], "press", "--workers", "1")
    outcome = strike(arena, *argv)
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "press: contains results of another sweep" in outcome.err and "--force" in outcome.err
    outcome = strike(arena, *argv, "--force", "--json")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err
    assert '"shards_written": 1' in outcome.out
    assert (arena / "press" / "notes.txt").read_text() == "ten years"


@pytest.mark.parametrize("name", ["plot", "report", *sorted({argv[0] for argv in WHOLE.values()}), "inspect"])
def test_each_command_that_writes_has_force(name: str) -> None:
    assert any("--force" in option.opts for option in build(name).params)


JSON_VALUES = (
    "NaN", "[]", "null", '"a"', '["\\u0000"]', '["../../x"]', '["/dev/zero"]', '{"b.svg": 3}', '{"b.svg": null}',
    '["."]', '[""]', "1e999", '["\\ud800"]', f'["{"x" * 300}"]', f'["{"a/" * 3000}"]',
)  # fmt: skip


def test_damaged_records_give_no_file_away(tmp_path: Path, hostile_full: bool) -> None:
    rng, out = random.Random(0), tmp_path / "out"
    with judging() as judge:
        for k in range(1000 if hostile_full else 50):
            shutil.rmtree(out, ignore_errors=True)
            with whole_folder(out, force=False, kind="result") as folder:
                (folder / "a.svg").write_text("old")
            (out / "b.svg").write_text("mine")
            text = (out / RECORD).read_text()
            if k % 2:
                content = json.loads(text)
                content[rng.choice([*content])] = json.loads(rng.choice(JSON_VALUES))
                (out / RECORD).write_text(json.dumps(content))
            else:
                (out / RECORD).write_bytes(spoiled(text, rng, JSON_VALUES))
            faults = []
            for use in (
                lambda: check_output(out, force=False, kind="result"),
                lambda: added(out, "b.svg"),
                lambda: check_output(out, force=True, kind="result"),
            ):
                try:
                    use()
                    faults.append("is accepted")
                except OutputError as error:
                    faults += [] if "out" in error.where else [f"names no place: {error.line}"]
                except Exception as error:
                    faults.append(repr(error))
            judge(f"record {k}", faults if (out / "b.svg").read_text() == "mine" else [*faults, "is lost"])


def added(out: Path, name: str) -> None:
    with added_files(out, force=False) as beside:
        (beside / name).write_text("new")
