"""Skip all tests of simulations without MuJoCo."""

from __future__ import annotations

import pytest

from tests.simulation.factories import needs_mujoco


@pytest.fixture(scope="session", autouse=True)
def _mujoco() -> None:
    needs_mujoco()
