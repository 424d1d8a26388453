"""A folder to attack in, with a small robot, and with what may not be lost."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.hostile.arena import SMALL, strike


@pytest.fixture(scope="session")
def loaded() -> None:
    """Everything imported once: each attack then is a fork."""
    import impact_posture.codegen.export
    import impact_posture.experiment.folders
    import impact_posture.impact.evaluation
    import impact_posture.posture.robustness
    import impact_posture.result_folder
    import impact_posture.robot.robot_summary
    import impact_posture.verification.verification  # noqa: F401


@pytest.fixture
def arena(tmp_path: Path, loaded: None) -> Path:
    (tmp_path / "small.urdf").write_text(SMALL)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("ten years")
    (tmp_path / "wrong.json").write_text('{"names": 3, "joints": ["nobody"]}')
    (tmp_path / "wrong.toml").write_text("[[[")
    sound = strike(tmp_path, "evaluate", "small.urdf", "--frame", "tip", "--normal", "0", "0", "1")
    assert (sound.code, sound.complaints) == (0, []), sound.err
    return tmp_path
