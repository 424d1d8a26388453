"""Output folders: whole or not at all, whoever interferes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from impact_posture.errors import OutputError
from impact_posture.folder import whole_folder

MARKS = ("result.json",)


def write(out: Path, text: str, *, force: bool = False) -> None:
    with whole_folder(out, force=force, marks=MARKS) as folder:
        (folder / "result.json").write_text(text)


def test_force_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    write(tmp_path / "out", "one")
    write(tmp_path / "out", "two", force=True)
    assert (tmp_path / "out" / "result.json").read_text() == "two"
    assert os.listdir(tmp_path) == ["out"]


def test_interrupt_between_the_renames_keeps_the_old_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "out", "one")
    real, calls = os.rename, []

    def rename(source: object, target: object) -> None:
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        real(source, target)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", "two", force=True)
    assert (tmp_path / "out" / "result.json").read_text() == "one"
    assert os.listdir(tmp_path) == ["out"]


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(OutputError, match="exists"), whole_folder(out, force=False, marks=MARKS) as folder:
        (folder / "result.json").write_text("mine")
        write(out, "theirs")
    assert (out / "result.json").read_text() == "theirs"
    assert os.listdir(tmp_path) == ["out"]


def test_failure_inside_leaves_nothing_and_made_parents_go(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), whole_folder(tmp_path / "a" / "b", force=False, marks=MARKS) as folder:
        (folder / "half").write_text("x")
        raise RuntimeError
    assert os.listdir(tmp_path) == []
