"""Return a folder for attacks, with a small robot and a file that no command may change."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hostile.arena import SMALL, strike


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Check that the small robot can be evaluated, and import all modules once before the forks."""
    import tests.support.command  # noqa: F401

    folder = tmp_path_factory.mktemp("sound")
    (folder / "small.urdf").write_text(SMALL)
    outcome = strike(folder, "evaluate", "small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
    assert (outcome.code, outcome.complaints) == (0, []), outcome.err


@pytest.fixture
def arena(tmp_path: Path, sound: None) -> Path:
    (tmp_path / "small.urdf").write_text(SMALL)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("ten years")
    (tmp_path / "wrong.json").write_text('{"names": 3, "joints": ["nobody"]}')
    (tmp_path / "wrong.toml").write_text("[[[")
    return tmp_path
