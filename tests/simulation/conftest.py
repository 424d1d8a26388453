"""Skip all simulation tests if MuJoCo is not installed."""

from __future__ import annotations

import pytest

from tests.simulation.factories import needs_mujoco


@pytest.fixture(scope="session", autouse=True)
def _mujoco() -> None:
    needs_mujoco()
