"""Settings that every test shares."""

from __future__ import annotations

import os
from collections.abc import Iterator

# Before numpy is imported: workers that share the cores must not each start a thread on every core.
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

from tests.rounding import other_rounding  # noqa: E402

# The same examples on every run and on every worker; a slow machine is no failure.
settings.register_profile(
    "impact-posture", deadline=None, derandomize=True, max_examples=20, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("impact-posture")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rounding", type=int, metavar="SEED", help="linear algebra as another processor may round it")
    parser.addoption("--hostile-full", action="store_true", help="attack at length: minutes instead of seconds")


@pytest.fixture
def hostile_full(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--hostile-full"))


@pytest.fixture(autouse=True, scope="session")
def rounding_of_this_run(request: pytest.FixtureRequest) -> Iterator[None]:
    seed = request.config.getoption("--rounding")
    if seed is None:
        yield
        return
    with other_rounding(seed):
        yield
