"""Settings that all tests share."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

# If Python may not write bytecode next to the sources, every test process would compile all imports again, which
# takes seconds.  A shared bytecode folder avoids the repeated compilation.
if sys.dont_write_bytecode and not sys.pycache_prefix:
    sys.pycache_prefix = str(Path(__file__).parents[1] / "build" / "bytecode")
    sys.dont_write_bytecode = False
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Limit the threads before numpy is imported, because parallel test workers would each start a thread per core.
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# A background job of a shell ignores SIGINT, and a program under nohup ignores SIGHUP.  The programs that tests
# start would inherit an ignored signal, but they do not inherit a handler that does nothing.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

from impact_posture.impact.impact_contact import ImpactContact  # noqa: E402
from impact_posture.impact.worst_case_objective import WorstCaseObjective  # noqa: E402
from impact_posture.posture.search import conflicts  # noqa: E402
from impact_posture.robot.robot_loader import load_robot  # noqa: E402
from tests.support.rounding import other_rounding  # noqa: E402

# Every run and every worker use the same examples; a slow machine must not cause a failure.
settings.register_profile(
    "impact-posture", deadline=None, derandomize=True, max_examples=20, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("impact-posture")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rounding", type=int, metavar="SEED", help="linear algebra as another processor may round it")
    parser.addoption("--hostile-full", action="store_true", help="attack at length: minutes instead of seconds")
    parser.addoption("--long", action="store_true", help="also run the tests and parameters that are marked as long")


def pytest_configure(config: pytest.Config) -> None:
    text = "long(but=()): needs --long, except for parameters whose ids are in but"
    config.addinivalue_line("markers", text)


def _deselect_long_tests(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect tests that need ``--long``.  Refuse ids in ``but`` that no parameter has, because it would not run."""
    short, long = list[pytest.Item](), list[pytest.Item]()
    unused: dict[str, set[str]] = {}
    for item in items:
        mark = item.get_closest_marker("long")
        ids = unused.setdefault(item.nodeid.partition("[")[0], set(mark.kwargs.get("but", ())) if mark else set())
        of_item = item.callspec.id if isinstance(item, pytest.Function) and hasattr(item, "callspec") else ""
        needed = mark is not None and of_item not in mark.kwargs.get("but", ())
        (long if needed else short).append(item)
        ids.discard(of_item)
    wrong = [f"{name}: {sorted(ids)}" for name, ids in unused.items() if ids]
    if wrong and not any("::" in argument for argument in config.args):
        raise pytest.UsageError("no parameter has an id in the mark `long`: " + "; ".join(wrong))
    if not (config.getoption("--long") or config.getoption("--hostile-full")):
        config.hook.pytest_deselected(items=long)
        items[:] = short


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let each worker begin with tests that fork, because a fork takes longer when a process uses more memory.

    At the start, ``--dist worksteal`` gives each worker an equal part of the list, without gaps.
    """
    _deselect_long_tests(config, items)
    parts = [item for item in items if _forks(item)], [item for item in items if not _forks(item)]
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    items[:] = [
        item
        for k in range(workers)
        for part in parts
        for item in part[len(part) * k // workers : len(part) * (k + 1) // workers]
    ]


def _forks(item: pytest.Item) -> bool:
    """Return whether the module of a test runs commands in forks."""
    runners = ("tests.support.command", "tests.hostile.arena")
    return any(getattr(value, "__module__", "") in runners for value in vars(item.module).values() if callable(value))


def pytest_collection_finish() -> None:
    """Freeze all imported objects, so that the garbage collector only examines objects that tests create."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="module", autouse=True)
def unoptimized(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compile C code without optimization; modules with ``OPTIMIZED = True`` use -O2, as users do."""
    with pytest.MonkeyPatch.context() as patch:
        if not getattr(request.module, "OPTIMIZED", False):
            patch.setenv("CFLAGS", "-O0")
        yield


@pytest.fixture
def few_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Relax infeasible problems from 4 of 12 postures, for tests of problems with an obvious conflict."""
    monkeypatch.setattr(conflicts, "_TRIES", 4)
    monkeypatch.setattr(conflicts, "_DRAWN", 12)


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


@pytest.fixture(scope="module")
def small() -> WorstCaseObjective:
    robot = load_robot("tilthex_arm")
    return WorstCaseObjective(
        robot, ImpactContact("ee", (1.0, 0.3, -0.2), (0.01, 0.02, 0.0), impulse=1.7), kind="sticking"
    )
