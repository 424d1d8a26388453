"""Full disks, sanitizers and odd folders give an error line that names the place, and leave no file."""

from __future__ import annotations

import os
import resource
import shutil
from pathlib import Path

import pytest

from impact_posture.errors import OutputError
from impact_posture.system.libraries import cache_path
from impact_posture.system.scratch_folder import scratch_folder
from tests.hostile.arena import PUSH, SMALL, SWEEP
from tests.support.command import refused, run
from tests.support.tools import files_of


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


# ---- full disks and compilers --------------------------------------------------------------------------------------


def test_a_sweep_on_a_full_disk_leaves_nothing(arena: Path) -> None:
    pytest.importorskip("pyarrow")
    (arena / "sweep.toml").write_text(SWEEP)
    before = names(arena)
    refused(run("sweep", "sweep.toml", "--out", "press", cwd=arena, prepare=files_of(600)), 1, "press", "too large")
    assert names(arena) == before


def test_a_world_on_a_full_disk_is_an_error(arena: Path) -> None:
    """MuJoCo itself reports a model that it cannot save only in a file, MUJOCO_LOG.TXT."""
    pytest.importorskip("mujoco")
    before = names(arena)
    done = run("simulate", "panda-tap", "--export-world", "world", cwd=arena, prepare=files_of(15_000))
    refused(done, 1, "world", "too large")
    assert names(arena) == before


def test_a_temporary_folder_on_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", fail)
    with pytest.raises(OSError) as caught, scratch_folder(tmp_path):
        raise AssertionError("is not reached")
    assert str(tmp_path) in caught.value.filename and not names(tmp_path)


def test_a_sanitizer_in_the_flags_of_the_compiler_is_named(arena: Path) -> None:
    """The runtime of AddressSanitizer ends a process that loads the library."""
    before = names(arena)
    done = run("codegen", *PUSH, "--compile", "--out", "out", cwd=arena, env={"CFLAGS": "-fsanitize=address"})
    # Without the library of the sanitizer, the compiler itself fails.
    refused(done, 1, "-fsanitize")
    assert names(arena) == before


# ---- folders -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "argv",
    [
        ("optimize", "panda", "--normal", "0", "0", "1"),
        ("codegen", "panda", "--normal", "0", "0", "1"),
        ("simulate", "panda-tap"),
        ("compare", "panda-tap", "--out", "out"),
        ("reproduce",),
    ],
    ids=lambda argv: argv[0],
)
def test_a_deleted_current_folder_is_named(argv: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    done = run(*argv, cwd=tmp_path / "gone", prepare=lambda: shutil.rmtree(tmp_path / "gone"))
    refused(done, 1, "the current folder: No such file or directory; it was deleted")


@pytest.fixture
def odd(tmp_path: Path, sound: None) -> Path:
    """A folder with a name that is not UTF-8."""
    folder = tmp_path / os.fsdecode(b"d\xff")
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system has only names in UTF-8")
    (folder / "small.urdf").write_text(SMALL)
    (folder / "sweep.toml").write_text(SWEEP)
    return folder


@pytest.mark.parametrize("name", ["inspect", "optimize", "sweep"])
def test_names_that_are_not_utf8_are_errors_before_any_work(name: str, odd: Path) -> None:
    """TOML and JSON must be UTF-8."""
    argv: dict[str, tuple[object, ...]] = {
        "inspect": ("inspect", odd / "small.urdf"),
        "optimize": ("optimize", *PUSH, "--contact-pose", "free"),
        "sweep": ("sweep", "sweep.toml"),
    }
    before = names(odd)
    done = run(*argv[name], cwd=odd)
    refused(done, 1, r"d\udcff/small.urdf' is not UTF-8", "rename the file or folder")
    assert names(odd) == before and "certif" not in done.stdout


def test_folders_that_are_not_utf8_can_be_written(odd: Path) -> None:
    pytest.importorskip("mujoco")
    for argv, file in (
        (("codegen", *PUSH), "small_tip-c/small_tip.c"),
        (("simulate", "panda-tap", "--export-world", odd / "world"), "world/world.mjb"),
    ):
        done = run(*argv, cwd=odd)
        assert (done.returncode, (odd / file).stat().st_size > 1000) == (0, True), done.stderr


@pytest.mark.parametrize("variable", ["IMPACT_POSTURE_CACHE", "XDG_CACHE_HOME", "HOME"])
def test_a_cache_that_is_not_utf8_is_named(variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """CasADi cannot load a library from a path that is not UTF-8."""
    for other in ("IMPACT_POSTURE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(other, raising=False)
    monkeypatch.setenv(variable, os.fsdecode(bytes(tmp_path) + b"/c\xff"))
    with pytest.raises(OutputError, match=r"c\\udcff.*is not UTF-8; set IMPACT_POSTURE_CACHE"):
        cache_path()


# ---- words ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("tradeoff = 3", "does not support 'tradeoff', 'path' and the search 'global'; remove these keys"),
        ('metric = "weighted"', "add 'weights' FILE or 'weights' velocity-limits"),
        ('support = ["lower"]', "choose reflected or link, or no 'support' for"),
        ('lock = ["elbow"]\nhold = ["elbow"]', "leave it out, or do not 'lock' it"),
    ],
    ids=["tradeoff", "weights", "support", "lock"],
)
def test_errors_of_a_sweep_file_name_keys_and_no_options(key: str, words: str, arena: Path) -> None:
    pytest.importorskip("pyarrow")
    (arena / "sweep.toml").write_text(SWEEP.replace("[grid]", f"{key}\n[grid]"))
    refused(run("sweep", "sweep.toml", cwd=arena), 1, words)


@pytest.mark.parametrize(
    "columns", ["99999999999", "0", "-1", "abc", "9" * 5000], ids=["wide", "0", "-1", "abc", "9s"]
)
def test_widths_that_no_terminal_has_do_not_count(columns: str) -> None:
    """Rich fills the lines of a page with spaces, up to the width in COLUMNS."""

    def limit() -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (2 << 30),) * 2)

    done = run("report", "--help", env={"COLUMNS": columns}, prepare=limit)
    assert (done.returncode, done.stderr) == (0, "") and "--meshes" in done.stdout and len(done.stdout) < 5000
