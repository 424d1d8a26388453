"""Libraries that are loaded: whole, of their manifest, and the user's own; what is not is refused and never run."""

from __future__ import annotations

import copy
import json
import os
import random
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
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

# Loads every folder that is named, and says what became of it; a crash ends it, and the last line says where.
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
    done = subprocess.run(
        [sys.executable, "-c", LOADER, *map(str, folders)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, f"{done.returncode} after {done.stdout.splitlines()[-1:]}: {done.stderr[-2000:]}"
    rows = [line.split() for line in done.stdout.splitlines()]
    return {Path(name).name: words for name, *words in rows}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export of two frames with its library and seal."""
    need_compiler()
    folder = tmp_path_factory.mktemp("export")
    robot = load_robot(PENDULUM)
    objectives = [
        WorstCaseObjective(robot, ImpactContact(f, (0.6, 0.8, 0), (0, 0.1, 0.2))) for f in robot.frame_names[-2:]
    ]
    export(objectives, folder, prefix="arm", check=False, portable=True)
    build_library(folder, "arm")
    return folder


def paths_of(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in a document."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        yield (*path, key)
        yield from paths_of(value, (*path, key))


def mutated(document: Any, rng: random.Random, path: tuple[Any, ...]) -> Any:
    """The document with another value at a place, of this type or another, or without it."""
    found = copy.deepcopy(document)
    node = found
    for key in path[:-1]:
        node = node[key]
    value = node[path[-1]]
    others: list[Any] = [
        None,
        "x",
        -1,
        0,
        10**9,
        10**30,
        1e308,
        [],
        {},
        [value],
        True,
        float("nan"),
        "../../x",
        [0.0] * 99,
    ]
    if isinstance(value, int | float):
        others += [value + 1, value * 2 + 1]
    if isinstance(value, str):
        others += [value + "x", "arm_manifest", "exit", "abort", "libc.so.6"]
    if isinstance(value, list):
        others += [value[:-1], [*value, *value[-1:]], value[::-1]]
    chosen = rng.choice([other for other in others if other != value])
    node[path[-1]] = chosen
    if rng.random() < 0.15:
        del node[path[-1]]
    return found


def test_no_manifest_that_does_not_fit_is_loaded(built: Path, tmp_path: Path) -> None:
    """Whatever is changed in it: the library names its manifest."""
    rng = random.Random(11)
    manifest = json.loads((built / "arm.json").read_text())
    places = [path for path in paths_of(manifest) if path != ("prefix",)]
    first = [
        path for path in places if path[0] in ("nq", "nv", "real", "frames", "joint_names", "armature", "symbols")
    ]
    documents = [mutated(manifest, rng, path) for path in rng.sample(first, 40) + rng.sample(places, 40)]
    # Consistent with itself, and wrong.
    for key, arrays in (("nq", ("q",)), ("nv", ("grad", "objective_grad", "jump"))):
        for size in (1, manifest[key] + 1, manifest[key] - 1, 4000):
            other = copy.deepcopy(manifest) | {key: size}
            other["armature"] = [0.0] * other["nv"]
            for frame in other["frames"]:
                for array in arrays:
                    frame["self_test"][array] = [0.5] * size
            documents.append(other)
    swapped = copy.deepcopy(manifest)
    swapped["frames"][0]["symbols"] = dict.fromkeys(manifest["symbols"], "exit")
    documents += [
        swapped,
        manifest | {"real": "float"},
        manifest | {"schema": "impact-posture/codegen/0"},
        [],
        3,
        None,
    ]
    folders = []
    for k, document in enumerate(documents):
        folders.append(tmp_path / f"m{k}")
        shutil.copytree(built, folders[-1])
        (folders[-1] / "arm.json").write_text(json.dumps(document))
    for k, text in enumerate(('{"schema"', "", "[" * 100_000, '{"schema":"impact-posture/codegen/1"}')):
        folders.append(tmp_path / f"t{k}")
        shutil.copytree(built, folders[-1])
        (folders[-1] / "arm.json").write_text(text)
    folders.append(tmp_path / "same")
    shutil.copytree(built, folders[-1])
    (folders[-1] / "arm.json").write_text(json.dumps(manifest, indent=7, sort_keys=True))
    said = load_all(folders)
    assert len(said) == len(folders) > 90
    assert said.pop("same") == ["loaded"], "written otherwise, it is the same"
    for name, words in said.items():
        assert words[0] in ("SpecError", "ManifestMismatch"), (name, words)


@pytest.mark.parametrize("prefix", ["../other/arm", "other", "", 3, "/etc/passwd", "arm\u0000", "a b"])
def test_a_prefix_is_no_path(built: Path, tmp_path: Path, prefix: object) -> None:
    folder = shutil.copytree(built, tmp_path / "c")
    manifest = json.loads((folder / "arm.json").read_text())
    (folder / "arm.json").write_text(json.dumps(manifest | {"prefix": prefix}))
    with pytest.raises((SpecError, CompilerError)):
        ImpactGradient.load(folder)


def damage(library: Path) -> dict[str, Callable[[], object]]:
    """What can become of a library, by name."""
    data = library.read_bytes()
    rng = random.Random(5)

    def cut(size: int) -> Callable[[], object]:
        return lambda: library.write_bytes(data[:size])

    def patch(place: int, value: bytes) -> Callable[[], object]:
        return lambda: library.write_bytes(data[:place] + value + data[place + len(value) :])

    sizes = [0, 1, 4, 16, 63, 64, 500, 4095, 4096, len(data) // 2, len(data) - 1, *rng.sample(range(len(data)), 10)]
    return {
        **{f"cut{size}": cut(size) for size in sizes},
        "text": lambda: library.write_text("no library\n"),
        "machine": patch(18, b"\xb7\x00" if data[18] != 0xB7 else b"\x3e\x00"),
        "class": patch(4, b"\x01" if data[4] == 2 else b"\x02"),
        "order": patch(5, b"\x02"),
        "identity": patch(4, b"\xff\xff"),
        "segments": patch(32, b"\xff" * 8),
        "sections": patch(40, b"\xff" * 8),
        "object": lambda: shutil.copy(sys.executable, library),
        "folder": lambda: (library.unlink(), library.mkdir()),
    }


@pytest.mark.skipif(sys.platform != "linux", reason="ELF")
@pytest.mark.parametrize("sealed", [True, False])
def test_no_damaged_library_is_loaded(built: Path, tmp_path: Path, sealed: bool) -> None:
    folders = []
    for name in damage(built / "libarm.so"):
        folders.append(shutil.copytree(built, tmp_path / name))
        library = folders[-1] / "libarm.so"
        damage(library)[name]()
        if not sealed:
            libraries.seal_path(library).unlink()
    for k in range(20 if sealed else 0):
        # Only a seal tells a byte that is another.
        folders.append(shutil.copytree(built, tmp_path / f"byte{k}"))
        data = bytearray((folders[-1] / "libarm.so").read_bytes())
        data[random.Random(k).randrange(len(data))] ^= 1 << k % 8
        (folders[-1] / "libarm.so").write_bytes(bytes(data))
    said = load_all(folders)
    assert len(said) == len(folders) > 25
    for name, words in said.items():
        assert words[0] in ("SpecError", "OutputError"), (name, words)


def test_a_library_of_another_export_is_refused(built: Path, tmp_path: Path) -> None:
    robot = load_robot(PENDULUM)
    other, mine = tmp_path / "other", shutil.copytree(built, tmp_path / "mine")
    other.mkdir()
    objective = WorstCaseObjective(robot, ImpactContact(robot.frame_names[-1], (1, 0, 0), (0, 0.1, 0.2)))
    export(objective, other, prefix="arm", check=False, portable=True)
    for name in ("libarm.so", "libarm.so.sha256"):
        shutil.copy(mine / name, other / name)
    # A library that says nothing of a manifest, with a seal or without.
    strange = shutil.copytree(built, tmp_path / "strange")
    (strange / "x.c").write_text("int arm_eval(void) { return 0; }\n")
    libraries.seal_path(build_library(strange, "x", strange / "libarm.so")).unlink()
    said = load_all([mine, other, strange])
    assert said["mine"] == ["loaded"]
    assert said["other"][:4] == ["ManifestMismatch", "the", "manifest's", "hash"]
    assert said["strange"][0] == "SpecError" and "arm_manifest" in said["strange"]


def test_a_library_that_make_built_is_loaded(built: Path, tmp_path: Path) -> None:
    """It replaces one that was sealed."""
    make, folder = need("make"), shutil.copytree(built, tmp_path / "c")
    subprocess.run([make, "-s", "shared", "CFLAGS=-O1"], cwd=folder, check=True)
    assert not (folder / "libarm.so.sha256").exists()
    assert ImpactGradient.load(folder).nq == read_manifest(folder)[0]["nq"]
    with pytest.raises(SpecError, match=r"another SHA-256.*delete libarm.so.sha256"):
        shutil.copy(built / "libarm.so.sha256", folder)
        ImpactGradient.load(folder)


def test_seals_are_what_sha256sum_reads(built: Path) -> None:
    subprocess.run([need("sha256sum"), "--check", "--quiet", "libarm.so.sha256"], cwd=built, check=True)


# ---- the cache ----------------------------------------------------------------------------------------------------


def test_where_the_cache_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("IMPACT_POSTURE_CACHE", raising=False)
    for given, expected in (
        ("", tmp_path / ".cache"), ("relative/path", tmp_path / ".cache"), (str(tmp_path / "x"), tmp_path / "x")
    ):  # fmt: skip
        monkeypatch.setenv("XDG_CACHE_HOME", given)
        assert libraries.cache_path() == expected / "impact-posture"
    folder = libraries.cache_folder("gradients")
    for made in (folder, folder.parent):
        assert stat.S_IMODE(made.stat().st_mode) == 0o700
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "own"))
    assert libraries.cache_folder() == tmp_path / "own"


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A library in the cache."""
    monkeypatch.setenv("IMPACT_POSTURE_CACHE", str(tmp_path / "cache"))
    library = libraries.cache_folder() / "kept.so"
    with libraries.building(library) as folder:
        (folder / "kept.so").write_bytes(b"code")
    assert libraries.is_cached(library)
    assert [path.name for path in library.parent.iterdir() if path.is_dir()] == []
    return library


@pytest.mark.parametrize("what", ["library", "folder"])
@pytest.mark.parametrize("fault", [stat.S_IWGRP, stat.S_IWOTH, "owner"])
def test_what_others_may_write_is_refused(kept: Path, what: str, fault: int | str) -> None:
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
    assert kept.read_bytes() == b"code"


def test_what_is_damaged_goes(kept: Path) -> None:
    kept.write_bytes(b"cod")
    assert not libraries.is_cached(kept)
    assert not kept.exists() and not libraries.is_cached(kept)
    kept.write_bytes(b"code")
    libraries.seal_path(kept).unlink()
    assert not libraries.is_cached(kept), "without a seal it may be anything"


def test_parts_that_libraries_have_in_common_are_compiled_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
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
    # Comments make no difference, what is included does.
    assert (built("c.so", 5), objects()) == (7, 3)
    (tmp_path / "two.h").write_text("#define TWO 20\n")
    assert (built("d.so", 5), objects()) == (25, 4)
    # A damaged object is compiled again.
    for path in (tmp_path / "cache" / "objects").glob("*.o"):
        path.write_bytes(b"")
    assert (built("e.so", 5), objects()) == (25, 4)
    (tmp_path / "one.c").write_text("int one(void) { return }\n")
    with pytest.raises(CompilerError, match=r"one\.c"):
        built("f.so", 5)
