"""Short scenarios."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from impact_posture.simulation.scenario_file import SHIPPED


def shortened(name: str, **values: float) -> str:
    """Return the text of a shipped scenario with changed values of some keys."""
    text = (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")
    for key, value in values.items():
        text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
        assert count, f"{name} has no {key}"
    return text


@pytest.fixture(scope="session")
def aerial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario with one early contact with the wall."""
    pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")
    path = tmp_path_factory.mktemp("scenarios") / "aerial.toml"
    short = {"count": 1, "settle": 0.1, "dwell": 0.2, "pause": 0.05, "gap": 0.06}
    path.write_text(shortened("aerial-lateral", **short, timestep=0.0005, period=0.002), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def push(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario with early pushes in both directions."""
    pytest.importorskip("mujoco", reason="mujoco is not installed (the extra 'sim')")
    path = tmp_path_factory.mktemp("scenarios") / "push.toml"
    short = {"settle": 0.3, "quiet": 0.5, "still": 0.05, "after": 0.1}
    path.write_text(shortened("solo8-push", **short, timestep=0.001, period=0.002), encoding="utf-8")
    return path
