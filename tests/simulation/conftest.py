"""Skip all simulation tests if MuJoCo is not installed, and build controllers for tests."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest

from impact_posture.system.libraries import cache_path
from tests.simulation.factories import needs_mujoco
from tests.support.daqp import sources_or_skip


@pytest.fixture(scope="session", autouse=True)
def _mujoco() -> None:
    needs_mujoco()


@pytest.fixture(scope="module")
def quick_builds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Use a separate cache and compile without optimization."""
    sources_or_skip()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CFLAGS", "-O0")
        cache, used = tmp_path_factory.mktemp("cache"), cache_path()
        for file in used.glob("daqp-*"):
            shutil.copy(file, cache)
        patch.setenv("IMPACT_POSTURE_CACHE", str(cache))
        yield
