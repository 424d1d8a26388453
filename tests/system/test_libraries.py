"""Shared libraries: damaged libraries and wrong manifests are rejected before any code runs; the cache is private."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.manifest_reader import read_manifest
from impact_posture.errors import CompilerError, OutputError, SpecError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system import libraries
from impact_posture.system.libraries import build_library, build_parts
from tests.output.views import PENDULUM
from tests.support.tools import need, need_compiler

# Program that loads each export folder and prints the result.  After a crash, the last printed line names the folder.
LOADER = """
import sys
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.errors import ImpactPostureError
for folder in sys.argv[1:]:
    print(folder, end=" ", flush=True)
    try:
        ImpactGradient.load(folder).objective
        print("loaded", flush=True)
    except ImpactPostureError as error:
        assert "\\n" not in error.line and error.hint, error
        print(type(error).__name__, error.what, flush=True)
"""


def load_all(folders: list[Path]) -> dict[str, list[str]]:
    """Load exports in another process and return the printed lines, with the folder name as key."""
    done = subprocess.run(
        [sys.executable, "-c", LOADER, *map(str, folders)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, f"{done.returncode} after {done.stdout.splitlines()[-1:]}: {done.stderr[-2000:]}"
    rows = [line.split() for line in done.stdout.splitlines()]
    return {Path(name).name: words for name, *words in rows}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export of two frames, with its library and hash."""
    need_compiler()
    folder = tmp_path_factory.mktemp("export")
    robot = load_robot(PENDULUM)
    objectives = [
        WorstCaseObjective(robot, ImpactContact(f, (0.6, 0.8, 0), (0, 0.1, 0.2))) for f in robot.frame_names[-2:]
    ]
    export(objectives, folder, prefix="arm", check=False, portable=True)
    build_library(folder, "arm")
    return folder


def changed(**keys: object) -> Callable[[dict[str, Any]], object]:
    """Return a function that changes keys of a manifest."""
    return lambda manifest: manifest | keys


def resized(key: str, size: int) -> Callable[[dict[str, Any]], object]:
    """Return a function that changes a size in a manifest, and every array of this size."""
    arrays = {"nq": ("q",), "nv": ("grad", "objective_grad", "jump")}[key]

    def change(manifest: dict[str, Any]) -> object:
        manifest[key] = size
        manifest["armature"] = [0.0] * manifest["nv"]
        for frame, array in itertools.product(manifest["frames"], arrays):
            frame["self_test"][array] = [0.5] * size
        return manifest

    return change


def with_other_symbols(manifest: dict[str, Any]) -> object:
    manifest["frames"][0]["symbols"] = dict.fromkeys(manifest["symbols"], "exit")
    return manifest


WRONG_MANIFESTS = [
    *(resized(key, size) for key in ("nq", "nv") for size in (1, 4, 4000)),
    *(changed(nq=value) for value in (None, "x", -1, 10**30, 1e308, [], True, float("nan"))),
    changed(real="float"),
    changed(schema="impact-posture/codegen/0"),
    changed(frames=[]),
    changed(joint_names=["x"] * 99),
    with_other_symbols,
    lambda _: [],
    lambda _: None,
]


def test_a_manifest_that_does_not_fit_is_refused(built: Path, tmp_path: Path) -> None:
    """The library contains the hash of its manifest."""
    text = (built / "arm.json").read_text()
    texts = [json.dumps(change(json.loads(text))) for change in WRONG_MANIFESTS]
    texts += ['{"schema"', "", "[" * 100_000, '{"schema":"impact-posture/codegen/1"}']
    for k, other in enumerate(texts):
        folder = shutil.copytree(built, tmp_path / f"m{k}")
        (folder / "arm.json").write_text(other)
    same = shutil.copytree(built, tmp_path / "same")
    (same / "arm.json").write_text(json.dumps(json.loads(text), indent=7, sort_keys=True))
    printed = load_all(sorted(tmp_path.iterdir()))
    assert printed.pop("same") == ["loaded"], "the layout of the text does not count"
    assert len(printed) == len(texts)
    for name, words in printed.items():
        assert words[0] in ("SpecError", "ManifestMismatch"), (name, words)


@pytest.mark.parametrize("prefix", ["../other/arm", "other", "", 3, "/etc/passwd", "arm\u0000", "a b"])
def test_a_prefix_that_is_not_an_identifier_is_refused(built: Path, tmp_path: Path, prefix: object) -> None:
    folder = shutil.copytree(built, tmp_path / "c")
    manifest = json.loads((folder / "arm.json").read_text())
    (folder / "arm.json").write_text(json.dumps(manifest | {"prefix": prefix}))
    with pytest.raises((SpecError, CompilerError)):
        ImpactGradient.load(folder)


@pytest.mark.skipif(sys.platform != "linux", reason="ELF")
@pytest.mark.parametrize("with_hash", [True, False])
def test_a_damaged_library_is_refused(built: Path, tmp_path: Path, with_hash: bool) -> None:
    """A truncated library would crash the process that loads it."""
    data = (built / "libarm.so").read_bytes()
    contents = [data[:size] for size in (0, 1, 16, 63, 64, 500, 4096, len(data) // 2, len(data) - 1)]
    contents += [b"text", data[:4] + b"\xff\xff" + data[6:], Path(sys.executable).read_bytes()]
    if with_hash:
        # The size of the file is unchanged, so only the hash reveals the changed byte.
        contents += [data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :] for place in (100, 9000, 12_000)]
    for k, content in enumerate(contents):
        folder = shutil.copytree(built, tmp_path / f"c{k}")
        (folder / "libarm.so").write_bytes(content)
        if not with_hash:
            (folder / "libarm.so.sha256").unlink()
    for name, words in load_all(sorted(tmp_path.iterdir())).items():
        assert words[0] == "SpecError", (name, words)


def test_a_library_of_another_export_is_refused(built: Path, tmp_path: Path) -> None:
    robot = load_robot(PENDULUM)
    other, mine = tmp_path / "other", shutil.copytree(built, tmp_path / "mine")
    other.mkdir()
    objective = WorstCaseObjective(robot, ImpactContact(robot.frame_names[-1], (1, 0, 0), (0, 0.1, 0.2)))
    export(objective, other, prefix="arm", check=False, portable=True)
    for name in ("libarm.so", "libarm.so.sha256"):
        shutil.copy(mine / name, other / name)
    # Use a library that does not contain the hash of a manifest.
    strange = shutil.copytree(built, tmp_path / "strange")
    (strange / "x.c").write_text("int arm_eval(void) { return 0; }\n")
    build_library(strange, "x", strange / "libarm.so")
    printed = load_all([mine, other, strange])
    assert printed["mine"] == ["loaded"]
    assert printed["other"][:4] == ["ManifestMismatch", "the", "manifest's", "hash"]
    assert printed["strange"][0] == "SpecError" and "arm_manifest" in printed["strange"]


def test_make_replaces_a_library_and_its_hash(built: Path, tmp_path: Path) -> None:
    make, folder = need("make"), shutil.copytree(built, tmp_path / "c")
    subprocess.run([make, "-s", "shared", "CFLAGS=-O1"], cwd=folder, check=True)
    assert not (folder / "libarm.so.sha256").exists()
    assert ImpactGradient.load(folder).nq == read_manifest(folder)[0]["nq"]
    with pytest.raises(SpecError, match=r"another SHA-256.*delete libarm.so.sha256"):
        shutil.copy(built / "libarm.so.sha256", folder)
        ImpactGradient.load(folder)


def test_sha256sum_reads_the_hash(built: Path) -> None:
    subprocess.run([need("sha256sum"), "--check", "--quiet", "libarm.so.sha256"], cwd=built, check=True)


# ---- the cache ----------------------------------------------------------------------------------------------------


def test_where_the_cache_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("IMPACT_POSTURE_CACHE", raising=False)
    home = tmp_path / ".cache"
    for variable, expected in (("", home), ("relative/path", home), (str(tmp_path / "x"), tmp_path / "x")):
        monkeypatch.setenv("XDG_CACHE_HOME", variable)
        assert libraries.cache_path() == expected / "impact-posture"
    folder = libraries.cache_folder("gradients")
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder, folder.parent)] == [0o700, 0o700]
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "chosen"))
    assert libraries.cache_folder() == tmp_path / "chosen"


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A compiled library in the cache."""
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    library = libraries.cache_folder() / "kept.so"
    with libraries.building(library) as folder:
        (folder / "kept.so").write_bytes(b"code")
    assert libraries.is_cached(library)
    assert [path.name for path in library.parent.iterdir() if path.is_dir()] == []
    return library


@pytest.mark.parametrize("what", ["library", "folder"])
@pytest.mark.parametrize("fault", [stat.S_IWGRP, stat.S_IWOTH, "owner"])
def test_a_path_that_others_may_write_is_refused(kept: Path, what: str, fault: int | str) -> None:
    path = kept if what == "library" else kept.parent
    if fault == "owner":
        if os.geteuid() != 0:
            pytest.skip("only root gives a file away")
        os.chown(path, 65534, -1)
    else:
        path.chmod(stat.S_IMODE(path.stat().st_mode) | int(fault))
    words = "belongs to another user" if fault == "owner" else "can be written by others"
    with pytest.raises(OutputError, match=words):
        libraries.is_cached(kept)
    if what == "folder":
        with pytest.raises(OutputError, match=words):
            libraries.cache_folder()


def test_a_changed_library_is_deleted(kept: Path) -> None:
    kept.write_bytes(b"cod")
    assert not libraries.is_cached(kept)
    assert not kept.exists() and not libraries.is_cached(kept)


def test_a_library_without_a_hash_is_not_cached(kept: Path) -> None:
    libraries.hash_path(kept).unlink()
    assert not libraries.is_cached(kept)


def test_common_parts_are_compiled_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    need_compiler()
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "two.h").write_text("#define TWO 2\n")
    (tmp_path / "one.c").write_text('#include "two.h"\nint other(void);\nint one(void) { return other() + TWO; }\n')

    def built(name: str, other: int) -> int:
        (tmp_path / "other.c").write_text(f"/* {name} */\nint other(void) {{ return {other}; }}\n")
        library = build_parts(tmp_path, tmp_path / name, {"one.c": (), "other.c": ("-O0",)})
        return int(libraries.load_library(library).one())

    def objects() -> int:
        return len(list((tmp_path / "cache" / "objects").glob("*.o")))

    assert (built("a.so", 1), objects()) == (3, 2)
    assert (built("b.so", 5), objects()) == (7, 3)
    # A comment does not change the cache key, but an included file does.
    assert (built("c.so", 5), objects()) == (7, 3)
    (tmp_path / "two.h").write_text("#define TWO 20\n")
    assert (built("d.so", 5), objects()) == (25, 4)
    # A damaged object file is compiled again.
    for path in (tmp_path / "cache" / "objects").glob("*.o"):
        path.write_bytes(b"")
    assert (built("e.so", 5), objects()) == (25, 4)
    (tmp_path / "one.c").write_text("int one(void) { return }\n")
    with pytest.raises(CompilerError, match=r"one\.c"):
        built("f.so", 5)
