"""A folder to attack in, with a small robot, and with what may not be lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hostile.arena import SMALL, strike


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The small robot can be evaluated, with everything imported once: each attack then is a fork."""
    import tests.support.command  # noqa: F401

    folder = tmp_path_factory.mktemp("sound")
    (folder / "small.urdf").write_text(SMALL)
    found = strike(folder, "evaluate", "small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
    assert (found.code, found.complaints) == (0, []), found.err


@pytest.fixture
def arena(tmp_path: Path, sound: None) -> Path:
    (tmp_path / "small.urdf").write_text(SMALL)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("ten years")
    (tmp_path / "wrong.json").write_text('{"names": 3, "joints": ["nobody"]}')
    (tmp_path / "wrong.toml").write_text("[[[")
    return tmp_path
