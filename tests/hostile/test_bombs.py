"""Small files that would exhaust memory, time or screen give an error in one short line."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from impact_posture.system.text_files import MOST_CHARACTERS
from tests.hostile.arena import strike

PUSH = ("small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
CONFIG = ("inspect", "small.urdf", "--config")
POSTURE = ("evaluate", *PUSH, "--posture")
NINES = 'a: &a ["x","x","x","x","x","x","x","x","x"]\n' + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
DIGITS = "1" * 5_000
LONG = "z" * 1_000_000

FILES = {
    "aliases as a number": ("p.yaml", NINES + "name: [shoulder]\nposition: [*i]\n", POSTURE, "not a number"),
    "aliases as a schema": ("p.yaml", NINES + "schema: *i\n", POSTURE, "is not a posture"),
    "aliases of themselves": ("p.yaml", "joints: &j\n  shoulder: *j\n", POSTURE, "recursive"),
    "empty float": ("p.yaml", 'joints:\n  shoulder: !!float ""\n', POSTURE, "not a number"),
    "not a bool": ("p.yaml", 'joints:\n  shoulder: !!bool "maybe"\n', POSTURE, "not a number"),
    "not a time": ("p.yaml", 'joints:\n  shoulder: !!timestamp "x"\n', POSTURE, "not a number"),
    "minutes and seconds": ("p.yaml", "joints:\n  shoulder: 0:1\n", POSTURE, "not a number"),
    "code in a tag": ("p.yaml", '!!python/object/apply:os.system ["touch gone"]\n', POSTURE, "holds no posture"),
    "names by the thousand": (
        "p.json", '{"name": [' + ",".join(f'"j{k}"' for k in range(100_000)) + '], "position": [0]}', POSTURE,
        "100000 names but 1 positions",
    ),
    "long value": ("p.json", f'{{"joints": {{"shoulder": "{LONG}"}}}}', POSTURE, "not a number"),
    "long key": ("p.json", f'{{"q": [1], "{LONG}": 1}}', POSTURE, "unknown key"),
    "digits in TOML": ("r.toml", f"[armature]\ndefault = {DIGITS}\n", CONFIG, "digits"),
    "hexadecimal digits": (
        "r.toml", f"[armature]\ndefault = 0x{'f' * 5_000}\n", CONFIG, "digits",
    ),
    "long key in TOML": ("r.toml", f'"{LONG}" = 1\n', CONFIG, "unknown key"),
    "null in a path": ("r.toml", '[model]\nsrdf = "a\\u0000b"\n', CONFIG, "is not a path"),
    "weight beyond all numbers": (
        "w.toml",
        f"shoulder = {'1' * 400}\n",
        ("evaluate", *PUSH, "--metric", "weighted", "--weights"),
        "not a number",
    ),
    "weight whose ellipsoid overflows": (
        "w.toml",
        "shoulder = 0.1\nelbow = 1e308\n",
        ("evaluate", *PUSH, "--metric", "weighted", "--weights"),
        "every weight must be above zero",
    ),
    "armature without end": ("w.toml", f"shoulder = {'1' * 400}\n", ("evaluate", *PUSH, "--armature"), "table"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_files_that_grow(name: str, arena: Path) -> None:
    file, text, argv, words = FILES[name]
    (arena / file).write_text(text)
    # The limit also applies to the fork, so that an attack cannot exhaust the memory of the machine.
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, limits[1]))
    try:
        outcome = strike(arena, *argv, file)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err[-500:]
    assert words in outcome.err and file in outcome.err.replace("robot.toml", "r.toml")
    assert len(outcome.err) < 1_500


def test_a_huge_file(arena: Path) -> None:
    (arena / "r.toml").touch()
    os.truncate(arena / "r.toml", MOST_CHARACTERS + 1)
    outcome = strike(arena, "inspect", "small.urdf", "--config", "r.toml")
    assert (outcome.code, outcome.complaints) == (1, [])
    assert "File too large" in outcome.err


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('xyz="0 0 0.2"', 'xyz="0 0 1e200"'),
        ('xyz="0 0 0.4"', 'xyz="0 0 1e308"'),
        ('mass value="0.8"', 'mass value="1e300"'),
    ],
)
def test_models_beyond_all_numbers(old: str, new: str, arena: Path) -> None:
    text = (arena / "small.urdf").read_text()
    assert old in text
    (arena / "huge.urdf").write_text(text.replace(old, new))
    outcome = strike(arena, "inspect", "huge.urdf", "--json")
    assert (outcome.code, outcome.complaints) == (1, []), outcome.err
    assert "huge.urdf" in outcome.err


@pytest.mark.parametrize(
    "words", [("--payload", "tip", "1e100"), ("--target-position", "1e300", "0", "0", "--contact-pose", "position")]
)
def test_tasks_beyond_all_numbers(words: tuple[str, ...], arena: Path) -> None:
    outcome = strike(arena, "optimize", *PUSH, *words, "--out", "precious", "--force")
    assert (outcome.code, outcome.complaints) == (2, []), outcome.err
    assert "up to 1e+" in outcome.err
