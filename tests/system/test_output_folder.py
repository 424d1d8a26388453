"""After any interruption, output folders are complete or absent; foreign files remain, temporary files do not."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import impact_posture as ip
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.draft.draft import write_draft
from impact_posture.errors import InputError, OutputError
from impact_posture.experiment.run_reports import write_run_report
from impact_posture.output.plot.style import save
from impact_posture.output.result_reader import load_view
from impact_posture.robot.posture_files import read_posture
from impact_posture.robot.robot_loader import load_robot
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.system.folder_record import Kind
from impact_posture.system.output_folder import added_files, check_output, whole_folder, write_whole
from impact_posture.system.scratch_folder import RECORD, SCRATCH, scratch_folder


def write(out: Path, text: str, *, force: bool = False, kind: Kind = "result") -> None:
    with whole_folder(out, force=force, kind=kind, products=("c/made.o",)) as folder:
        (folder / "result.json").write_text(text)
        (folder / "c").mkdir()
        (folder / "c" / "a.c").write_text(text)


def content(folder: Path) -> dict[str, str]:
    files = (path for path in sorted(folder.rglob("*")) if path.name != RECORD)
    return {path.relative_to(folder).as_posix(): "" if path.is_dir() else path.read_text() for path in files}


def test_force_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    write(tmp_path / "out", "one")
    (tmp_path / "out" / "c" / "made.o").write_text("a product of the Makefile")
    write(tmp_path / "out", "two", force=True)
    assert content(tmp_path) == {"out": "", "out/c": "", "out/c/a.c": "two", "out/result.json": "two"}


# ---- foreign files -------------------------------------------------------------------------------------------------


def replace_by_link(out: Path) -> None:
    (out / "result.json").rename(out.parent / "elsewhere.json")
    (out / "result.json").symlink_to(out.parent / "elsewhere.json")


BROKEN_RECORD = '{"schema": "impact-posture/folder/1", "files": 3}'


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda out: (out / "notes.txt").write_text("ten years"), "notes.txt"),
        (lambda out: (out / "c" / "thesis.tex").write_text("ten years"), "c/thesis.tex"),
        (lambda out: (out / "mine" / "deep").mkdir(parents=True), "mine/"),
        (replace_by_link, "result.json"),
        (lambda out: (out / RECORD).unlink(), "c/, result.json"),
        (lambda out: (out / RECORD).write_text(BROKEN_RECORD), ".impact-posture.json, c/, result.json"),
    ],
)
def test_force_names_foreign_files_and_keeps_them(
    change: Callable[[Path], object], named: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    write(out, "one")
    change(out)
    before = content(tmp_path)
    with pytest.raises(OutputError) as caught:
        write(out, "two", force=True)
    assert f"holds {named}, which this command did not write" in caught.value.line
    assert content(tmp_path) == before


def test_a_result_without_a_record_is_foreign(tmp_path: Path) -> None:
    out = tmp_path / "experiment"
    out.mkdir()
    (out / "result.json").write_text('{"schema": "impact-posture/result/1"}')
    with pytest.raises(OutputError, match=r"holds result\.json, which"):
        write(out, "two", force=True)
    assert content(out) == {"result.json": '{"schema": "impact-posture/result/1"}'}


def test_the_results_of_another_command_are_kept(tmp_path: Path) -> None:
    write(tmp_path / "out", "one")
    with pytest.raises(OutputError, match=r"another command's results \(result\)"):
        write(tmp_path / "out", "two", force=True, kind="export")
    assert content(tmp_path / "out")["result.json"] == "one"


def test_files_that_are_added_to_the_record_are_replaced(tmp_path: Path) -> None:
    write(tmp_path / "out", "one")
    (tmp_path / "out" / "jump.svg").write_text("a picture")
    with pytest.raises(OutputError, match=r"jump\.svg"):
        write(tmp_path / "out", "two", force=True)
    with added_files(tmp_path / "out", force=True) as beside:
        (beside / "jump.svg").write_text("another picture")
    assert content(tmp_path / "out")["jump.svg"] == "another picture"
    write(tmp_path / "out", "two", force=True)
    assert content(tmp_path / "out")["result.json"] == "two"


# ---- files that are added to a folder ------------------------------------------------------------------------------


def add(out: Path, text: str, *, force: bool = False) -> None:
    with added_files(out, force=force) as beside:
        for name in ("a.svg", "b.svg"):
            (beside / name).write_text(text)


def state(folder: Path) -> dict[str, tuple[int, int]]:
    """Return inode and time of each file.  Replacing or writing a file changes at least one."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return {str(path): (path.lstat().st_ino, path.lstat().st_mtime_ns) for path in paths}


def edit(path: Path) -> None:
    path.write_text(path.read_text() + "a note")


def link_to_thesis(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.parents[1] / "thesis.txt")


def make_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("change", [edit, link_to_thesis, make_pipe])
@pytest.mark.parametrize("recorded", [True, False])
def test_changed_files_are_only_replaced_by_force(
    change: Callable[[Path], None], recorded: bool, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    (tmp_path / "thesis.txt").write_text("ten years")
    if recorded:
        write(out, "old")
    add(out, "old")
    add(out, "newer")
    assert (out / "a.svg").read_text() == "newer"
    change(out / "b.svg")
    before = state(tmp_path)
    with pytest.raises(OutputError, match=r"out/b\.svg: was not written by this program, or was changed.*`force`"):
        add(out, "new")
    assert state(tmp_path) == before
    add(out, "new", force=True)
    add(out, "newest")
    assert (out / "b.svg").read_text() == "newest" and not (out / "b.svg").is_symlink()
    assert (tmp_path / "thesis.txt").read_text() == "ten years"
    assert sorted(os.listdir(out)) == sorted([RECORD, "a.svg", "b.svg", *(["c", "result.json"] if recorded else [])])


def test_a_folder_with_the_name_of_a_file_is_kept(tmp_path: Path) -> None:
    (tmp_path / "out" / "b.svg").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"b\.svg: is a folder"):
        add(tmp_path / "out", "new", force=True)
    assert os.listdir(tmp_path / "out") == ["b.svg"]


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with (
        pytest.raises(OutputError, match=r"b\.svg: was not written by this program"),
        added_files(out, force=False) as new,
    ):
        for name in ("a.svg", "b.svg"):
            (new / name).write_text("new")
        (out / "b.svg").write_text("mine")
    assert content(out) == {"b.svg": "mine"}


@pytest.mark.parametrize("fault", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("at", [0, 1])
@pytest.mark.parametrize("links", [True, False])
def test_all_files_are_replaced_or_none(
    fault: type[BaseException], at: int, links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    write(out, "old")
    add(out, "old")
    (out / "a.svg").unlink()
    before, replace, calls = state(tmp_path), os.replace, []

    def fail_late(source: Path, target: Path) -> None:
        calls.append(source)
        if source.parent.name == "new" and len(calls) > at:
            raise fault
        replace(source, target)

    def no_links(*_: object, **__: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "replace", fail_late)
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        add(out, "new")
    assert state(tmp_path) == before


def test_files_in_a_record_without_hashes_count_as_ours(tmp_path: Path) -> None:
    """Version 0.2 wrote no hashes, so it is unknown whether somebody changed a file that it lists."""
    out = tmp_path / "out"
    write(out, "old")
    add(out, "old")
    old = json.loads((out / RECORD).read_text())
    del old["sha256"]
    (out / RECORD).write_text(json.dumps(old))
    edit(out / "a.svg")
    add(out, "new")
    edit(out / "a.svg")
    with pytest.raises(OutputError, match=r"a\.svg"):
        add(out, "newer")


def test_a_changed_file_is_named_before_a_folder_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "old")
    edit(out / "c" / "a.c")
    with pytest.raises(OutputError, match=r"exists, and it holds changes of yours in c/a\.c; .*`force`"):
        write(out, "new")
    write(out, "new", force=True)
    # A subfolder with a newer record of its own does not count as changed.
    shutil.rmtree(out / "c")
    write(out / "c", "newer")
    with pytest.raises(OutputError, match="exists;"):
        write(out, "newest")


def test_a_foreign_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write(out, "one")
    with (
        pytest.raises(OutputError, match=r"holds late\.txt"),
        whole_folder(out, force=True, kind="result") as folder,
    ):
        (folder / "result.json").write_text("two")
        (out / "late.txt").write_text("just now")
    assert content(out) == {"c": "", "c/a.c": "one", "result.json": "one", "late.txt": "just now"}
    assert os.listdir(tmp_path) == ["out"]


def a_link(place: Path) -> Path:
    (place / "link").symlink_to(place / "nowhere")
    return place / "link"


def a_file(place: Path) -> Path:
    (place / "file").write_text("x")
    return place / "file"


def a_pipe(place: Path) -> Path:
    os.mkfifo(place / "pipe")
    return place / "pipe"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (a_link, "is a symbolic link"),
        (a_file, "is not a folder"),
        (a_pipe, "is not a folder"),
        (lambda place: Path(), "current folder"),
        (lambda place: Path(".."), "current folder"),
        (lambda place: place.parent, "current folder"),
        (lambda place: Path("/"), "current folder"),
        (lambda place: Path("/proc"), "mount point"),
        (lambda place: a_file(place) / "below", "cannot be written"),
    ],
)
@pytest.mark.parametrize("force", [False, True])
def test_places_that_cannot_be_an_output_folder(
    make: Callable[[Path], Path], words: str, force: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = make(tmp_path)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(OutputError, match=words):
        check_output(out, force=force, kind="result")
    with pytest.raises(OutputError, match=words), whole_folder(out, force=force, kind="result"):
        raise AssertionError("is not reached")
    assert sorted(os.listdir(tmp_path)) == before


def test_a_file_is_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("ten years")
    for name in ("x.json", f".x.json.{os.getpid()}.part"):
        (tmp_path / name).symlink_to(tmp_path / "thesis.txt")
    write_whole(tmp_path / "x.json", "ours")
    assert content(tmp_path) == {"thesis.txt": "ten years", "x.json": "ours"}


@pytest.mark.parametrize("kind", ["device", "pipe"])
def test_an_endless_record_does_not_count(kind: str, tmp_path: Path) -> None:
    (tmp_path / f"{SCRATCH}0").mkdir()
    os.mkfifo(tmp_path / f"{SCRATCH}0" / RECORD)
    write(tmp_path / "out", "one")
    (tmp_path / "out" / RECORD).unlink()
    if kind == "device":
        (tmp_path / "out" / RECORD).symlink_to("/dev/zero")
    else:
        os.mkfifo(tmp_path / "out" / RECORD)
    with pytest.raises(OutputError, match="which this command did not write"):
        write(tmp_path / "out", "two", force=True)


# ---- interruptions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [1, 2])
def test_interrupt_between_the_renames_keeps_the_old_result(
    at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "out", "one")
    real, calls = os.rename, []

    def rename(source: object, target: object) -> None:
        calls.append(target)
        if len(calls) == at:
            raise KeyboardInterrupt
        real(source, target)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "rename", rename)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", "two", force=True)
    assert (tmp_path / "out" / "result.json").read_text() == "one"
    assert os.listdir(tmp_path) == ["out"]


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(OutputError, match="exists"), whole_folder(out, force=False, kind="result") as folder:
        (folder / "result.json").write_text("mine")
        write(out, "theirs")
    assert (out / "result.json").read_text() == "theirs"
    assert os.listdir(tmp_path) == ["out"]


def test_a_failure_leaves_nothing_not_even_new_parents(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b" / "c"
    with pytest.raises(RuntimeError), whole_folder(out, force=False, kind="result") as folder:
        (folder / "half").write_text("x")
        raise RuntimeError
    assert os.listdir(tmp_path) == []


KILLED = """
import os, signal, sys
from pathlib import Path
from impact_posture.system.output_folder import whole_folder
from impact_posture.system.scratch_folder import scratch_folder

with whole_folder(Path(sys.argv[1], "out"), force=False, kind="result") as folder, scratch_folder(folder):
    (folder / "half").write_text("x")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("writing", ["whole", "added"])
def test_a_file_elsewhere_that_fails_is_named(writing: str, tmp_path: Path) -> None:
    other, out = tmp_path / "style.txt", tmp_path / "out"
    folder = whole_folder(out, force=False, kind="result") if writing == "whole" else added_files(out, force=False)
    with pytest.raises(OutputError) as caught, folder:
        other.read_text()
    assert str(other) in caught.value.what
    assert "space" not in caught.value.hint
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", [None, "out", "out/result.json", "."])
def test_a_relative_folder_is_not_a_file_elsewhere(
    name: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = (13, "Permission denied") if name is None else (13, "Permission denied", name)
    with pytest.raises(OutputError) as caught, whole_folder(Path("out"), force=False, kind="result"):
        raise OSError(*arguments)
    assert "because of" not in str(caught.value) and "choose another" in str(caught.value)


def test_a_folder_of_a_killed_command_in_a_result_is_not_foreign(tmp_path: Path) -> None:
    write(tmp_path / "out", "one")
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "out")], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL and len(list((tmp_path / "out").iterdir())) == 4
    write(tmp_path / "out", "two", force=True)
    assert content(tmp_path)["out/result.json"] == "two"


def test_the_next_run_removes_only_the_folder_of_a_killed_run(tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False, timeout=60)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    others = {
        ".impact-posture-notes": {"notes.txt": "not ours"},
        ".impact-posture-00000000": {RECORD: '{"schema": "another/1"}'},
        ".impact-posture-11111111": {RECORD: "[]"},
        ".impact-posture-22222222": {RECORD: json.dumps({"schema": "impact-posture/folder/1", "host": "elsewhere"})},
        ".out-abcdef": {"result.json": "{}"},
    }
    for name, files in others.items():
        (tmp_path / name).mkdir()
        for file, text in files.items():
            (tmp_path / name / file).write_text(text)
    with scratch_folder(tmp_path) as alive:
        write(tmp_path / "out", "whole")
        assert alive.is_dir(), "a process works in it"
    assert not left.exists()
    assert sorted(os.listdir(tmp_path)) == sorted([*others, "out"])
    assert all((tmp_path / name / file).read_text() == text for name in others for file, text in others[name].items())


# ---- impossible file names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "a\ud800"])
def test_names_that_no_file_can_have_are_refused(name: str, tmp_path: Path) -> None:
    arm, contact = load_robot("tilthex_arm"), ip.ImpactContact("ee", (0.0, 0.0, 1.0))
    objective, out = ip.ImpactObjective(arm, contact), tmp_path / name
    for use in (
        lambda: write(out, "one"),
        lambda: objective.export(out, build=False),
        lambda: save(Figure(), out, "one"),
        lambda: write_draft("example-robot-data:ur_description/urdf/ur5_robot.urdf", LoadOptions(), out),
        lambda: load_robot(str(out)),
        lambda: load_robot(name),
        lambda: load_robot("ur5", srdf=str(out)),
        lambda: load_robot("ur5", package_dir=(str(out),)),
        lambda: read_posture(arm, name, where="posture"),
        lambda: read_scenario(name),
        lambda: load_view(out),
        lambda: write_run_report(out),
        lambda: ip.ImpactGradient.load(out),
    ):
        with pytest.raises(InputError) as caught:
            use()
        assert caught.value.hint and "\n" not in caught.value.line
    assert not list(tmp_path.iterdir())


def test_a_long_name_between_folders_that_are_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught:
        write(tmp_path / "missing" / ("x" * 300) / "out", "one")
    assert "x" * 300 in caught.value.where and not list(tmp_path.iterdir())
