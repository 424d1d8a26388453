"""A user meets caches, temporary folders and results that another user owns, or that a link leads to.

``--hostile-full`` tries more commands and results.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import matplotlib.style  # noqa: F401 (reads a folder in the home of root, which other users cannot)
import pytest

from impact_posture.output import plot
from impact_posture_cli.process import prepare
from tests.hostile.arena import SMALL, strike

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as two users"),
    pytest.mark.skipif(
        not all(folder.stat().st_mode & 1 for folder in Path(os.__file__).resolve().parents),
        reason="other users cannot read this Python",
    ),
]

ANN, BOB = 54_321, 54_322
PUSH = ("../small.urdf", "--frame", "tip", "--normal", "1", "0", "0.3")
OPTIMIZE = ("optimize", *PUSH, "--contact-pose", "free", "--starts", "1", "--no-report", "--quiet", "--format", "svg")


@pytest.fixture
def homes(sound: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that everyone can read, with the homes of two users, a shared folder and a robot."""
    monkeypatch.setattr(plot, "FIGURES", {"jump": plot.FIGURES["jump"]})
    root = Path(tempfile.mkdtemp(prefix="hostile-users-"))
    root.chmod(0o755)
    (root / "small.urdf").write_text(SMALL)
    for name, owner, mode in (("ann", ANN, 0o755), ("bob", BOB, 0o755), ("shared", 0, 0o1777), ("open", ANN, 0o777)):
        (root / name).mkdir()
        os.chown(root / name, owner, owner)
        (root / name).chmod(mode)
    yield root
    shutil.rmtree(root)


def become(user: int, home: Path, **variables: str) -> Callable[[], None]:
    """Return a function that turns a process into a process of a user."""

    def change() -> None:
        os.setgroups([])
        os.setgid(user)
        os.setuid(user)
        tempfile.tempdir = None
        for name in ("IMPACT_POSTURE_CACHE", "XDG_CACHE_HOME", "MPLCONFIGDIR", "TMPDIR"):
            os.environ.pop(name, None)
        os.environ.update({"HOME": str(home), **variables})

    return change


def make(path: Path, owner: int, mode: int, content: str | None = None) -> Path:
    if content is None:
        path.mkdir()
    else:
        path.write_text(content)
    os.chown(path, owner, owner)
    path.chmod(mode)
    return path


def cache_of_another(homes: Path) -> dict[str, str]:
    return {"IMPACT_POSTURE_CACHE": str(make(homes / "shared" / "cache", ANN, 0o755))}


def cache_for_all(homes: Path) -> dict[str, str]:
    return {"IMPACT_POSTURE_CACHE": str(make(homes / "shared" / "cache", BOB, 0o777))}


def cache_behind_a_link(homes: Path) -> dict[str, str]:
    make(homes / "ann" / "cache", ANN, 0o777)
    (homes / "shared" / "cache").symlink_to(homes / "ann" / "cache")
    return {"IMPACT_POSTURE_CACHE": str(homes / "shared" / "cache")}


def part_of_another(homes: Path) -> dict[str, str]:
    cache = make(homes / "bob" / "cache", BOB, 0o755)
    for name in ("objects", "metrics", "gradients", "programs", "controllers", "batches", "solvers"):
        make(cache / name, ANN, 0o755)
    return {"IMPACT_POSTURE_CACHE": str(cache)}


def cache_is_a_file(homes: Path) -> dict[str, str]:
    return {"IMPACT_POSTURE_CACHE": str(make(homes / "bob" / "cache", BOB, 0o644, ""))}


def home_of_another(homes: Path) -> dict[str, str]:
    return {"HOME": str(homes / "ann")}


def closed_home(homes: Path) -> dict[str, str]:
    return {"HOME": str(make(homes / "closed", ANN, 0o700))}


def no_home(homes: Path) -> dict[str, str]:
    return {"HOME": str(homes / "nowhere")}


def closed_temporary_folder(homes: Path) -> dict[str, str]:
    return {"TMPDIR": str(make(homes / "temporary", ANN, 0o700))}


def traps_in_the_temporary_folder(homes: Path) -> dict[str, str]:
    temporary = make(homes / "temporary", 0, 0o1777)
    thesis = make(homes / "bob" / "thesis", BOB, 0o755)
    make(thesis / "thesis.txt", BOB, 0o644, "ten years")
    (temporary / ".impact-posture-00000000").symlink_to(thesis)
    trap = make(temporary / ".impact-posture-00000001", ANN, 0o777)
    record = '{"schema": "impact-posture/folder/1"}'
    make(trap / ".impact-posture.json", ANN, 0o666, record)
    (trap / "link").symlink_to(thesis)
    make(temporary / ".impact-posture-00000002", BOB, 0o777)
    (temporary / ".impact-posture-00000002" / ".impact-posture.json").symlink_to(trap / ".impact-posture.json")
    return {"TMPDIR": str(temporary)}


SURROUNDINGS = (
    cache_of_another, cache_for_all, cache_behind_a_link, part_of_another, cache_is_a_file, home_of_another,
    closed_home, no_home, closed_temporary_folder, traps_in_the_temporary_folder,
)  # fmt: skip
COMMANDS = {
    "evaluate": ("evaluate", *PUSH),
    "compile": ("codegen", *PUSH, "--compile", "--out", "out"),
    "optimize": (*OPTIMIZE, "--out", "out"),
    "simulate": ("simulate", "solo8-push", "--compile", "always", "--out", "out"),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("surrounding", SURROUNDINGS, ids=lambda function: function.__name__)
def test_surroundings_of_another_user(
    surrounding: Callable[[Path], dict[str, str]], command: str, homes: Path, hostile_full: bool
) -> None:
    if command != "compile" and not hostile_full:
        pytest.skip("more commands of two users: give --hostile-full")
    variables = surrounding(homes)
    before = become(BOB, homes / "bob", **variables)
    outcome = strike(homes / "bob", *COMMANDS[command], before=before)
    complaints = [fault for fault in outcome.complaints if "cache" not in fault]
    assert not complaints, (complaints, outcome.err[-500:])
    if (homes / "bob" / "thesis").exists():
        assert (homes / "bob" / "thesis" / "thesis.txt").read_text() == "ten years"
        assert (homes / "temporary" / ".impact-posture-00000001").exists()


def result_of_ann(homes: Path, where: str, mode: int = 0o755) -> Path:
    """Let the first user write a result, and return its folder."""
    work = homes / where
    before = become(ANN, homes / "ann")
    outcome = strike(work, *OPTIMIZE, "--no-codegen", "--out", "out", before=before)
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err
    (work / "out").chmod(mode)
    return work / "out"


def linked_result(homes: Path) -> Path:
    result = result_of_ann(homes, "ann")
    (homes / "shared" / "out").symlink_to(result)
    return homes / "shared" / "out"


def linked_page(homes: Path) -> Path:
    """Let a page in a folder of the first user be a link to a file of the second user."""
    result = result_of_ann(homes, "open", 0o777)
    thesis = make(homes / "bob" / "thesis.txt", BOB, 0o644, "ten years")
    for name in ("report.html", "jump.svg", "result.json.part"):
        (result / name).unlink(missing_ok=True)
        (result / name).symlink_to(thesis)
    return result


RESULTS = {
    "closed home": lambda homes: make(homes / "closed", ANN, 0o700) / "out",
    "home": lambda homes: homes / "ann" / "out",
    "result in a home": lambda homes: result_of_ann(homes, "ann"),
    "result in an open folder": lambda homes: result_of_ann(homes, "open"),
    "open result in an open folder": lambda homes: result_of_ann(homes, "open", 0o777),
    "result in a sticky folder": lambda homes: result_of_ann(homes, "shared"),
    "open result in a sticky folder": lambda homes: result_of_ann(homes, "shared", 0o777),
    "linked result": linked_result,
    "linked page": linked_page,
}
USES = {
    "optimize": (*OPTIMIZE, "--no-codegen", "--force", "--out", "{folder}"),
    "report": ("report", "{folder}"),
    "plot": ("plot", "{folder}", "--figure", "jump", "--format", "svg"),
    "codegen": ("codegen", "{folder}", "--out", "{beside}"),
    "verify": ("verify", "{folder}", "--samples", "1"),
}


QUICK = [
    ("result in an open folder", "optimize", 0o022),
    ("linked page", "report", 0o022),
    ("open result in an open folder", "report", 0o777),
]


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("where", RESULTS)
@pytest.mark.parametrize("umask", [0o022, 0o777, 0o000])
def test_results_of_another_user(where: str, use: str, umask: int, homes: Path, hostile_full: bool) -> None:
    if (where, use, umask) not in QUICK and not hostile_full:
        pytest.skip("more results of two users: give --hostile-full")
    folder = RESULTS[where](homes)
    enter = become(BOB, homes / "bob")

    def before() -> None:
        enter()
        os.umask(umask)
        prepare()
        os.chdir(homes / "bob")

    words = [word.format(folder=folder, beside=folder.with_name("c")) for word in USES[use]]
    outcome = strike(homes, *words, before=before)
    complaints = [fault for fault in outcome.complaints if "fails and leaves" not in fault]
    complaints += [f"leaves {name}" for name in outcome.changed if outcome.code and "cache" not in name]
    assert not complaints, (complaints, outcome.err[-500:])
    if where == "linked page":
        assert (homes / "bob" / "thesis.txt").read_text() == "ten years"
    assert not [path for path in homes.rglob(".impact-posture-*") if "cache" not in path.parts]
